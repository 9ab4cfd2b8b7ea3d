"""Compiled libraries on disk: a private folder, each entry with its digest beside it."""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import socket
import stat
import tempfile
import time
from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path

from difffilter.engine.notice import tell

__all__ = ["cache_folder", "entry", "folders", "key_of", "store", "workshop"]

#: s after which a working folder is left over, where nobody can tell whether its process lives.
OLD = 86400.0
#: s, for one whose name tells no process.
NAMELESS = 600.0


def cache_folder() -> Path | None:
    """``DIFFFILTER_CACHE``, else a folder in the user's cache; None without a home."""
    named = os.environ.get("DIFFFILTER_CACHE")
    if named:
        return Path(named)
    base = os.environ.get("XDG_CACHE_HOME")
    try:
        return (Path(base) if base else Path.home() / ".cache") / "difffilter"
    except RuntimeError:
        return None


def folders() -> Iterator[Path]:
    """Where libraries may be: the cache where it can be used, then one for this process.

    Raises:
        OSError: there is no folder for temporary files either.
    """
    folder = cache_folder()
    if folder is None:
        tell("engine cache: found no home folder, expected one (or DIFFFILTER_CACHE)", KEPT)
    else:
        try:
            _private(folder)
        except OSError as error:
            tell(f"engine cache: {error}", KEPT)
        else:
            _clean(folder)
            yield folder
    yield _own()


#: What follows from a cache that cannot be used.
KEPT = "compiled filters are not kept"


def _private(folder: Path) -> None:
    """Make the folder; OSError where it is none, another's, or others may write in it."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    found = folder.stat()
    if not stat.S_ISDIR(found.st_mode):
        raise OSError(f"found {folder}, a file, expected a folder")
    if hasattr(os, "geteuid") and found.st_uid != os.geteuid():
        raise OSError(f"found {folder} of another user, expected your own folder")
    if os.name == "posix" and found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise OSError(f"found {folder} that others may write in, expected chmod go-w {folder}")


@lru_cache(maxsize=1)
def _own() -> Path:
    """A private folder that ends with the process."""
    folder = Path(tempfile.mkdtemp(prefix="difffilter-"))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return folder


@lru_cache(maxsize=8)
def _clean(folder: Path) -> None:
    """Remove the working folders of processes that are gone, once."""
    for found in folder.glob("tmp*"):
        try:
            age = time.time() - found.stat().st_mtime
        except OSError:
            continue
        if found.is_dir() and _left(found.name, age):
            shutil.rmtree(found, ignore_errors=True)


def _left(name: str, age: float) -> bool:
    """Whether a working folder is left over."""
    parts = name.split("-")
    if len(parts) != 4 or not parts[2].isdigit():
        return age > NAMELESS
    if parts[1] != _host():
        return age > OLD
    try:
        os.kill(int(parts[2]), 0)
    except (ProcessLookupError, OverflowError):
        return True
    except OSError:
        pass  # alive, of another user
    return age > OLD


def _host() -> str:
    return hashlib.sha256(socket.gethostname().encode()).hexdigest()[:8]


def workshop(folder: Path) -> tempfile.TemporaryDirectory[str]:
    """A folder inside to compile in; its name tells whose it is."""
    return tempfile.TemporaryDirectory(dir=folder, prefix=f"tmp-{_host()}-{os.getpid()}-")


def entry(folder: Path, key: str, kind: str = ".so") -> Path | None:
    """The file under a key (of :func:`key_of`), if it is whole: what its digest says."""
    path, beside = _places(folder, key, kind)
    try:
        found, wanted = _digest(key, path.read_bytes()), beside.read_text(encoding="ascii")
    except (OSError, UnicodeDecodeError):
        return None
    return path if found == wanted.strip() else None


def store(folder: Path, key: str, made: Path, kind: str = ".so") -> Path:
    """Put a file under a key, its digest first; each file whole or not at all."""
    path, beside = _places(folder, key, kind)
    digest = made.with_suffix(".sha256")
    digest.write_text(_digest(key, made.read_bytes()) + "\n", encoding="ascii")
    for target in (path, beside):
        if target.is_dir() and not target.is_symlink():
            shutil.rmtree(target)
    os.replace(digest, beside)
    os.replace(made, path)
    return path


def key_of(*parts: str) -> str:
    """A key that says all that an entry depends on."""
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _places(folder: Path, key: str, kind: str) -> tuple[Path, Path]:
    return folder / f"{key[:32]}{kind}", folder / f"{key[:32]}.sha256"


def _digest(key: str, content: bytes) -> str:
    """Of key and content: another entry's file is not this one's."""
    return hashlib.sha256(bytes.fromhex(key) + content).hexdigest()
