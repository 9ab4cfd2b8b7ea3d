"""Resumable state of a tuning run: tensors and plain data in one file, no pickle."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import torch

from difffilter.errors import CheckpointError
from difffilter.files import write_atomically

__all__ = ["load_state", "save_state", "state_path"]

STATE_VERSION = 1


def state_path(out: str | Path) -> Path:
    """Where the state of the run that writes ``out`` stands."""
    return Path(out).with_suffix(".state.pt")


def save_state(path: Path, state: dict[str, Any]) -> None:
    """Write atomically; the file holds tensors, numbers, texts, lists and dicts only."""
    content = {"version": STATE_VERSION, **state}
    write_atomically(path, lambda file: torch.save(content, file))


def load_state(path: Path, fingerprint: str) -> dict[str, Any]:
    """Read with ``weights_only=True``.

    Raises:
        CheckpointError: no such file, damaged, another version, or the state of another run
            (other scenario, settings, seed or logs, by their ``fingerprint``).
    """
    if not path.is_file():
        raise CheckpointError(f"{path}: found no such file, expected the state of a run to resume")
    try:
        state = torch.load(path, weights_only=True)
    except (RuntimeError, OSError, EOFError, ValueError, pickle.UnpicklingError) as error:
        reason = str(error).splitlines()[0]
        raise CheckpointError(f"{path}: damaged or not a tuning state: {reason}") from None
    if not isinstance(state, dict) or state.get("version") != STATE_VERSION:
        raise CheckpointError(f"{path}: version: expected {STATE_VERSION}")
    if state["fingerprint"] != fingerprint:
        raise CheckpointError(
            f"{path}: belongs to another run (scenario, settings, seed or logs differ), "
            "expected the same; delete it to start anew"
        )
    return state
