"""Resumable state of a tuning run: tensors and plain data in one file, no pickle."""

from __future__ import annotations

import fcntl
import glob
import hashlib
import io
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from difffilter.errors import CheckpointError, DifffilterError, InputError
from difffilter.files import write_atomically

__all__ = ["load_state", "only_run", "read_state", "save_state", "sound", "state_path"]

#: First bytes of a state file; the SHA-256 of all that follows it comes next.
MAGIC = b"difffilter tuning state 2\n"
DIGEST = hashlib.sha256().digest_size


def state_path(out: str | Path) -> Path:
    """Where the state of the run that writes ``out`` stands."""
    return Path(out).with_suffix(".state.pt")


@contextmanager
def only_run(path: Path) -> Iterator[None]:
    """Hold a lock beside a state file: a second run into the same one is refused.

    What a killed run left half-written beside it is removed.

    Raises:
        InputError: another run holds the lock; a place that cannot be written.
    """
    lock = path.with_name(f".{path.name}.lock")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle = _locked(lock)
    except OSError as error:
        raise InputError(f"{path}: cannot be written: {error.strerror}") from None
    try:
        for left in path.parent.glob(f".{glob.escape(path.name)}.????????"):
            left.unlink(missing_ok=True)
        yield
    finally:
        lock.unlink(missing_ok=True)
        os.close(handle)


def _locked(lock: Path) -> int:
    """An open file that is locked and still in its place."""
    while True:
        handle = os.open(lock, os.O_CREAT | os.O_RDWR, 0o666)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if os.path.samestat(os.fstat(handle), os.stat(lock)):
                return handle
        except BlockingIOError:
            os.close(handle)
            raise InputError(
                f"{lock.with_name(lock.name[1:-5])}: another run writes it, expected one at a time"
            ) from None
        except FileNotFoundError:
            pass  # whoever held it has just removed it
        os.close(handle)


def save_state(path: Path, state: dict[str, Any]) -> None:
    """Write atomically; the file holds tensors, numbers, texts, lists and dicts only.

    PyTorch does not notice a changed number in its own files, hence the digest.
    """
    buffer = io.BytesIO()
    torch.save(state, buffer)
    content = buffer.getvalue()
    write_atomically(path, MAGIC + hashlib.sha256(content).digest() + content)


def read_state(path: Path) -> bytes:
    """The bytes of a state file; CheckpointError without one."""
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise CheckpointError(
            f"{path}: found no such file, expected the state of a run to resume"
        ) from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror}") from None


@contextmanager
def sound(path: Path) -> Iterator[None]:
    """CheckpointError where what a state holds is not what a run of this version saves."""
    try:
        yield
    except DifffilterError:
        raise
    except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
        raise CheckpointError(
            f"{path}: damaged, or not a tuning state of this version ({type(error).__name__})"
        ) from None


def load_state(path: Path, fingerprint: str, data: bytes | None = None) -> dict[str, Any]:
    """Read with ``weights_only=True``.

    Args:
        data: the bytes of the file, where another process has read them.

    Raises:
        CheckpointError: no such file, damaged, another version, or the state of another run
            (other scenario, settings, seed or logs, by their ``fingerprint``).
    """
    data = read_state(path) if data is None else data
    digest, content = data[len(MAGIC) :][:DIGEST], data[len(MAGIC) + DIGEST :]
    if not data.startswith(MAGIC) or hashlib.sha256(content).digest() != digest:
        raise CheckpointError(f"{path}: damaged, or not a tuning state of this version")
    try:
        state: dict[str, Any] = torch.load(io.BytesIO(content), weights_only=True)
        found = state["fingerprint"]
    except Exception:  # torch and pickle raise many kinds for contents that are not a state
        raise CheckpointError(f"{path}: damaged, or not a tuning state of this version") from None
    if found != fingerprint:
        raise CheckpointError(
            f"{path}: belongs to another run (scenario, settings, seed or logs differ), "
            "expected the same; delete it to start anew"
        )
    return state
