"""Measurements in child processes: peak memory, times to compile, a whole tuning."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from typing import Any

from difffilter.errors import EngineError

__all__ = ["compile_times", "measured"]

_RUN = """\
import time
began = time.perf_counter()
import torch
imported = time.perf_counter()
from difffilter.bench.worker import main
main(began, imported)
"""


def measured(
    what: str, seconds: float, environment: Mapping[str, str] | None = None, **asked: Any
) -> dict[str, float] | None:
    """What the worker found; None if it takes longer than ``seconds``.

    Raises:
        EngineError: it failed; its last line of complaint.
    """
    command = [sys.executable, "-c", _RUN, json.dumps({"what": what, **asked})]
    with subprocess.Popen(
        command,
        env=os.environ | dict(environment or {}),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as child:
        try:
            out, complaint = child.communicate(timeout=seconds)
        except BaseException as error:
            _end(child)  # and the compiler that it may wait for
            if isinstance(error, subprocess.TimeoutExpired):
                return None
            raise
    if child.returncode:
        last = (complaint.strip() or f"exit code {child.returncode}").splitlines()[-1]
        raise EngineError(f"bench: the measurement of {what} failed: {last}")
    found: dict[str, float] = json.loads(out.splitlines()[-1])
    return found


def compile_times(
    filter: str, seconds: float
) -> tuple[dict[str, float] | None, dict[str, float] | None]:
    """With an empty cache, then with what that left there."""
    with tempfile.TemporaryDirectory(prefix="difffilter-bench-") as folder:
        cache = {"DIFFFILTER_CACHE": folder}
        cold = measured("compile", seconds, cache, filter=filter)
        warm = None if cold is None else measured("compile", seconds, cache, filter=filter)
    return cold, warm


def _end(child: subprocess.Popen[str]) -> None:
    try:
        os.killpg(child.pid, signal.SIGKILL)
    except (OSError, AttributeError):
        child.kill()
    child.wait()
