"""Robust Kalman-type filters in pure PyTorch: tuned by gradient, frozen, compared, deployed.

Public names are those of ``__init__.pyi``, one line each. A name is imported when it is first
used, so that what needs no PyTorch does not wait for it.
"""

from __future__ import annotations

import ast
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any


def _homes() -> dict[str, str]:
    """Module of each public name, by the stub beside this file."""
    stub = ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8"))
    return {
        entry.name: str(node.module)
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for entry in node.names
    }


_HOMES = _homes()
__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        value = getattr(import_module(_HOMES[name]), name)
    elif not name.startswith("_") and find_spec(f"{__name__}.{name}"):
        value = import_module(f"{__name__}.{name}")
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
