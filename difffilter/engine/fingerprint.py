"""What a recipe is, as text: equal texts trace to equal programs."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache, partial
from pathlib import Path
from types import FunctionType
from typing import Any

import torch

__all__ = ["fingerprint"]

LIBRARY = Path(__file__).resolve().parent.parent


class _UnknownError(Exception):
    """Something whose behaviour its parts do not tell: a user's function or class."""


def fingerprint(*things: object) -> str | None:
    """A text that determines what is traced; None where a user's own code takes part.

    The library's own code is told by the digest of its files, so that a function of it is told
    by its name, what it encloses and its defaults.
    """
    try:
        parts = [_text(thing) for thing in things]
    except (_UnknownError, RecursionError):
        return None
    text = "\n".join([_library(), torch.__version__, *parts])
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


@lru_cache(maxsize=1)
def _library() -> str:
    """Digest of the library's code."""
    digest = hashlib.sha256()
    for path in sorted(LIBRARY.rglob("*.py")):
        content = path.read_bytes()
        digest.update(f"{path.relative_to(LIBRARY)} {len(content)}\n".encode())
        digest.update(content)
    return digest.hexdigest()


def _text(x: Any) -> str:
    if x is None or isinstance(x, (bool, int, float, str, bytes, torch.dtype)):
        return f"{type(x).__name__} {x!r}"
    if isinstance(x, torch.Tensor):
        numbers = x.detach().cpu().contiguous()
        return f"tensor {x.dtype} {list(x.shape)} {numbers.tolist()!r}"
    if isinstance(x, (set, frozenset)):
        return f"set {sorted(map(_text, x))}"
    if isinstance(x, (tuple, list)):
        return f"{_name(type(x))} [{', '.join(map(_text, x))}]"
    if isinstance(x, Mapping):
        return f"mapping {{{', '.join(f'{_text(k)}: {_text(v)}' for k, v in x.items())}}}"
    if isinstance(x, partial):
        return f"partial {_text(x.func)} {_text(x.args)} {_text(x.keywords)}"
    if isinstance(x, type):
        return _name(x)
    return _function(x) if isinstance(x, FunctionType) else _instance(x)


def _function(x: FunctionType) -> str:
    try:
        enclosed = [cell.cell_contents for cell in x.__closure__ or ()]
    except ValueError:  # not yet filled
        raise _UnknownError from None
    more = [x.__defaults__, x.__kwdefaults__, enclosed, x.__code__.co_firstlineno]
    return f"{_name(x)} {_text(more)}"


def _instance(x: Any) -> str:
    """A dataclass by its fields, another object of the library by its attributes."""
    if is_dataclass(x):
        names = [field.name for field in fields(x)]
    elif hasattr(x, "__dict__"):
        names = sorted(vars(x))
    else:
        raise _UnknownError
    return f"{_name(type(x))} {_text({name: getattr(x, name) for name in names})}"


def _name(x: Any) -> str:
    """Module and name of the library's or Python's own; no others are known by their names."""
    module = str(x.__module__)
    if module != "builtins" and not module.startswith("difffilter."):
        raise _UnknownError
    return f"{module}.{x.__qualname__}"
