"""Compile C to a shared object, cached on disk under source, compiler and flags."""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
import tempfile
from functools import lru_cache
from pathlib import Path

from difffilter.errors import EngineError

__all__ = ["build", "cache_folder", "compiler"]

#: Fast arithmetic that keeps NaN and infinity visible and the order of sums.
FLAGS: tuple[str, ...] = (
    "-std=gnu11", "-march=native", "-fopenmp", "-fno-math-errno", "-fno-trapping-math",
    "-ffp-contract=fast", "-fPIC", "-shared", "-w",
)  # fmt: skip
if platform.machine().lower() in ("x86_64", "amd64"):
    FLAGS += ("-mprefer-vector-width=512",)
#: Characters of source above which -O1 has to do: -O2 takes minutes there for a tenth less time.
LARGE = 600_000


def _flags(source: str) -> tuple[str, ...]:
    return ("-O1" if len(source) > LARGE else "-O2", *FLAGS)


def compiler() -> str | None:
    """The C compiler: ``DIFFFILTER_CC``, else cc or gcc; None without one."""
    return os.environ.get("DIFFFILTER_CC") or shutil.which("cc") or shutil.which("gcc")


def cache_folder() -> Path:
    """``DIFFFILTER_CACHE``, else a folder in the user's cache."""
    named = os.environ.get("DIFFFILTER_CACHE")
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "difffilter"


@lru_cache(maxsize=64)
def build(source: str) -> ctypes.CDLL:
    """The compiled library; from the cache where it is there.

    Raises:
        EngineError: no compiler, or one that fails (its first line of complaint).
    """
    cc = compiler()
    if cc is None:
        raise EngineError("engine: found no C compiler, expected cc or gcc (or DIFFFILTER_CC)")
    key = "\n".join([source, cc, *_flags(source), platform.platform(), _processor()])
    path = cache_folder() / f"{hashlib.sha256(key.encode()).hexdigest()[:32]}.so"
    if not path.is_file():
        _compile(cc, source, path)
    return ctypes.CDLL(str(path))


def _processor() -> str:
    """What -march=native depends on: a home folder may serve several machines."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    kept = [line for line in lines if line.startswith(("model name", "flags", "Features"))]
    return "\n".join(sorted(set(kept))) or platform.processor()


def _compile(cc: str, source: str, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=path.parent) as folder:
        code, made = Path(folder) / "step.c", Path(folder) / "step.so"
        code.write_text(source, encoding="utf-8")
        command = [cc, *_flags(source), str(code), "-o", str(made), "-lm"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            complaint = (done.stderr.strip() or "no message").splitlines()[0]
            raise EngineError(f"engine: {cc} failed: {complaint}")
        os.replace(made, path)  # atomic: another process sees all of it or nothing
