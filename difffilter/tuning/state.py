"""Resumable state of a tuning run: tensors and plain data in one file, no pickle."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any

import torch

from difffilter.errors import CheckpointError
from difffilter.files import write_atomically

__all__ = ["load_state", "read_state", "save_state", "state_path"]

#: First bytes of a state file; the SHA-256 of all that follows it comes next.
MAGIC = b"difffilter tuning state 1\n"
DIGEST = hashlib.sha256().digest_size


def state_path(out: str | Path) -> Path:
    """Where the state of the run that writes ``out`` stands."""
    return Path(out).with_suffix(".state.pt")


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
    state: dict[str, Any] = torch.load(io.BytesIO(content), weights_only=True)
    if state["fingerprint"] != fingerprint:
        raise CheckpointError(
            f"{path}: belongs to another run (scenario, settings, seed or logs differ), "
            "expected the same; delete it to start anew"
        )
    return state
