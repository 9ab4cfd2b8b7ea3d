"""What the numbers were measured on."""

from __future__ import annotations

import os
import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

from difffilter.bench.peers import installed
from difffilter.engine.build import compiler
from difffilter.errors import EngineError

__all__ = ["machine", "need_compiler"]


def need_compiler() -> str:
    """The compiler and its version.

    Raises:
        EngineError: there is none, or it cannot be run.
    """
    cc = compiler()
    if cc is None:
        raise EngineError("bench: found no C compiler, expected cc or gcc (or DIFFFILTER_CC)")
    try:
        done = subprocess.run([cc, "--version"], capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        raise EngineError(
            f"bench: the C compiler {cc} cannot be run, expected cc or gcc (or DIFFFILTER_CC)"
        ) from None
    return (done.stdout.splitlines() or [cc])[0]


def machine(peers: tuple[str, ...]) -> dict[str, Any]:
    """Processor, cores, threads, compiler, versions of peers."""
    names = [*peers, *(["jaxlib"] if {"jax", "dynamax"} & set(peers) else [])]
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS") or "not set: all cores",
        "torch threads": torch.get_num_threads(),
        "compiler": need_compiler(),
        "system": platform.platform(),
        "peers": {name: installed(name) for name in names},
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
