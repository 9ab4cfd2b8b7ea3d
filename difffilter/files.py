"""Files that are whole or absent, and the data that travel with the package."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from difffilter.errors import InputError

__all__ = ["data_folder", "write_atomically"]


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


def data_folder(name: str) -> Path:
    """Folder ``scenarios`` or ``checkpoints``: in the wheel, or beside the package's source."""
    package = Path(__file__).parent
    inside = package / name
    return inside if inside.is_dir() else package.parent / name
