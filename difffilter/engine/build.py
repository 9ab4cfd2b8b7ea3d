"""Compile C to a shared object, cached under source, compiler and flags."""

from __future__ import annotations

import ctypes
import json
import os
import platform
import shutil
import subprocess
from functools import lru_cache
from pathlib import Path

from difffilter.engine.cache import cache_folder, entry, folders, key_of, store, workshop
from difffilter.errors import EngineError

__all__ = ["build", "cache_folder", "compiler", "known", "note"]

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


@lru_cache(maxsize=64)
def build(source: str) -> ctypes.CDLL:
    """The compiled library; from the cache where it is there and whole.

    Raises:
        EngineError: no compiler, or one that fails (its first line of complaint); no folder
            that a library can be loaded from.
    """
    cc = compiler()
    if cc is None:
        raise EngineError("engine: found no C compiler, expected cc or gcc (or DIFFFILTER_CC)")
    key = _key(source, cc)
    complaint = "no folder"
    try:
        for folder in folders():
            try:
                return _load(entry(folder, key) or _compile(cc, source, folder, key))
            except OSError as error:  # read-only, full, or nothing may be run from there
                complaint = str(error)
    except OSError as error:
        complaint = str(error)
    raise EngineError(f"engine: found no folder to compile in ({complaint})")


def _key(source: str, cc: str) -> str:
    return key_of(source, cc, *_flags(source), platform.platform(), _processor())


def note(name: str, text: str, source: str) -> None:
    """Keep a text with a built source under a name, so that :func:`known` finds both."""
    cc = compiler() or ""
    content = json.dumps({"library": _key(source, cc), "text": text})
    try:
        for folder in folders():
            with workshop(folder) as inside:
                made = Path(inside) / "note.json"
                made.write_text(content, encoding="utf-8")
                store(folder, _note_key(name, cc), made, ".json")
            return
    except OSError:
        return  # it is written anew then


def known(name: str) -> tuple[str, ctypes.CDLL] | None:
    """Text and library under a name; None where either is not there or not whole."""
    cc = compiler()
    if cc is None:
        return None
    try:
        folder = next(folders())
        path = entry(folder, _note_key(name, cc), ".json")
        if path is None:
            return None
        said = json.loads(path.read_text(encoding="utf-8"))
        library = entry(folder, str(said["library"]))
        return None if library is None else (str(said["text"]), _load(library))
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _note_key(name: str, cc: str) -> str:
    return key_of("note", name, cc, *FLAGS, platform.platform(), _processor())


def _load(path: Path) -> ctypes.CDLL:
    try:
        return ctypes.CDLL(str(path))
    except OSError:
        path.unlink(missing_ok=True)  # not to be met again
        raise


@lru_cache(maxsize=1)
def _processor() -> str:
    """What -march=native depends on: a home folder may serve several machines."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    kept = [line for line in lines if line.startswith(("model name", "flags", "Features"))]
    return "\n".join(sorted(set(kept))) or platform.processor()


def _compile(cc: str, source: str, folder: Path, key: str) -> Path:
    with workshop(folder) as inside:
        code, made = Path(inside) / "step.c", Path(inside) / "step.so"
        code.write_text(source, encoding="utf-8")
        command = [cc, *_flags(source), str(code), "-o", str(made), "-lm"]
        try:
            done = subprocess.run(command, capture_output=True, check=False)
        except OSError as error:
            raise EngineError(f"engine: {cc} failed: {error.strerror or error}") from None
        said = done.stderr.decode("utf-8", "replace").strip()
        if done.returncode and "No space left" in said:
            raise OSError(said.splitlines()[0])
        if done.returncode:
            complaint = said.splitlines()[0] if said else f"exit code {done.returncode}"
            raise EngineError(f"engine: {cc} failed: {complaint:.200}")
        if not made.is_file() or not made.stat().st_size:
            raise EngineError(f"engine: {cc} failed: it wrote no library")
        return store(folder, key, made)
