"""Which line of whose code calls an operation."""

from __future__ import annotations

import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

__all__ = ["origin"]

LIBRARY = Path(__file__).resolve().parent.parent
TORCH = Path(torch.__file__).resolve().parent


class _Finder(TorchDispatchMode):  # type: ignore[no-untyped-call]
    """Notes where an operation is first called."""

    def __init__(self, operation: str) -> None:
        super().__init__()  # type: ignore[no-untyped-call]
        self.operation, self.where = operation, ""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        if not self.where and str(func) == self.operation:
            frames = [f for f in traceback.extract_stack() if TORCH not in Path(f.filename).parents]
            own = [f for f in frames if LIBRARY in Path(f.filename).parents and f.name != "_"]
            last = frames.index(own[0]) if own else 0
            # The user's model stands below the library's step; else the library's own line.
            below = [f for f in frames[last:] if LIBRARY not in Path(f.filename).parents]
            frame = (below or own or frames)[-1]
            self.where = f", used at {frame.filename}:{frame.lineno}: {frame.line}"
        return func(*args, **(kwargs or {}))


def origin(operation: str, call: Callable[[], object]) -> str:
    """Text that names file and line of an operation's first call; "" if there is none."""
    finder = _Finder(operation)
    with torch.no_grad(), finder:
        call()
    return finder.where
