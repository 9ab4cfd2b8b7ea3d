"""Files that are whole or absent, JSON of finite numbers, and the package's own data."""

from __future__ import annotations

import glob
import json
import math
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, BinaryIO

from difffilter.errors import InputError

__all__ = ["data_folder", "json_text", "write_atomically", "write_together"]

#: Seconds after which a half-written file that nobody touches is left by a killed process.
LEFT = 3600.0


def write_atomically(path: str | Path, content: str | bytes | Callable[[BinaryIO], None]) -> None:
    """Write a file beside its place, then move it there: never half-written.

    Args:
        path: the file; its folder is made if missing.
        content: text (UTF-8), bytes, or a function that writes to an open binary file.

    Raises:
        InputError: the place cannot be written.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _clean(path.parent, f".{glob.escape(path.name)}.????????")
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    try:
        with os.fdopen(handle, "wb") as file:
            if callable(content):
                content(file)
            else:
                file.write(content.encode() if isinstance(content, str) else content)
        umask = os.umask(0)
        os.umask(umask)
        os.chmod(name, 0o666 & ~umask)
        os.replace(name, path)
    except OSError as error:
        Path(name).unlink(missing_ok=True)
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise


def write_together(folder: str | Path, files: Mapping[str, str]) -> None:
    """Write texts into a folder, all or none: beside their places first, then moved there.

    Args:
        folder: made if missing; files: text (UTF-8) by name.

    Raises:
        InputError: a place that cannot be written.
    """
    folder = Path(folder)
    for name in files:
        if (folder / name).is_dir():
            raise InputError(f"{folder / name}: found a folder, expected a file")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        _clean(folder, ".difffilter-????????")
        with tempfile.TemporaryDirectory(dir=folder, prefix=".difffilter-") as aside:
            for name, text in files.items():
                write_atomically(Path(aside) / name, text)
            for name in files:
                os.replace(Path(aside) / name, folder / name)
    except OSError as error:
        raise InputError(f"{folder}: cannot be written: {error.strerror}") from None


def _clean(folder: Path, pattern: str) -> None:
    """Remove what killed processes left half-written; what is younger may still be in use."""
    for left in folder.glob(pattern):
        with suppress(OSError):
            if time.time() - left.stat().st_mtime > LEFT:
                shutil.rmtree(left) if left.is_dir() else left.unlink()


def data_folder(name: str) -> Path:
    """Folder ``scenarios`` or ``checkpoints``: in the wheel, or beside the package's source."""
    package = Path(__file__).parent
    inside = package / name
    return inside if inside.is_dir() else package.parent / name


def json_text(data: Mapping[str, Any]) -> str:
    """JSON with finite numbers only: null for NaN and infinity."""
    return json.dumps(_finite(data), indent=2, allow_nan=False)


def _finite(value: Any) -> Any:
    """The same nested data with None for what is not finite."""
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, Mapping):
        return {str(key): _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    return value
