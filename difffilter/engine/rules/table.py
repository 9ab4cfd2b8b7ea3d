"""The table of rules, and what all of them use."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

import numpy as np

from difffilter.engine.program import Program
from difffilter.registry import Registry

__all__ = ["RULES", "Array", "Lower", "Rule", "array", "binary", "rule", "unary"]

Array = np.ndarray[Any, Any]


class Lower(Protocol):
    """What a rule is given: a maker of expressions, entry by entry."""

    program: Program

    def constant(self, value: Any) -> Array:
        """Numbers as an array of constant nodes."""
        ...

    def of(self, value: Any) -> Array:
        """An array, made of a number where needed."""
        ...

    def map(self, op: str, *args: Any) -> Array:
        """An operation on every entry, broadcasting."""
        ...

    def fold(self, op: str, x: Array, dims: Any, keepdim: bool) -> Array:
        """An operation from entry to entry along dimensions, in order."""
        ...

    def known(self, x: Any) -> Array | None:
        """The numbers of an array of constants; None if one is computed."""
        ...


#: Arrays in, arrays out; further arguments as the ATen operation's.
Rule = Callable[..., Any]
R = TypeVar("R", bound=Rule)
#: By the operation's name without the underscores around it.
RULES: Registry[Rule] = Registry("engine rule")


def rule(*names: str) -> Callable[[R], R]:
    """Register a rule under the names of ATen operations."""

    def register(entry: R) -> R:
        for name in names:
            RULES.add(name, entry)
        return entry

    return register


def unary(*ops: str) -> None:
    """Register operations of one argument that the program knows by the same name."""
    for op in ops:
        RULES.add(op, lambda low, x, op=op: low.map(op, x))


def binary(*ops: str) -> None:
    """Register operations of two arguments that the program knows by the same name."""
    for op in ops:
        RULES.add(op, lambda low, a, b, op=op: low.map(op, a, b))


def array(value: Any) -> Array:
    """An array of nodes."""
    return np.asarray(value, dtype=object)
