"""A scalar program: shared expressions over inputs, folded as they are made."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from difffilter.errors import EngineError

__all__ = ["BOOLEAN", "Program"]

#: Operations of a step above which a compiler takes minutes.
LARGEST = 60_000
#: Operations whose value is a truth value.
BOOLEAN = {"lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "isnan"}

_FOLD: dict[str, Callable[..., Any]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "min": lambda a, b: math.nan if math.isnan(a) or math.isnan(b) else min(a, b),
    "max": lambda a, b: math.nan if math.isnan(a) or math.isnan(b) else max(a, b),
    "neg": lambda a: -a,
    "abs": abs,
    "lt": lambda a, b: float(a < b),
    "le": lambda a, b: float(a <= b),
    "gt": lambda a, b: float(a > b),
    "ge": lambda a, b: float(a >= b),
    "eq": lambda a, b: float(a == b),
    "ne": lambda a, b: float(a != b),
    "and": lambda a, b: float(bool(a) and bool(b)),
    "or": lambda a, b: float(bool(a) or bool(b)),
    "not": lambda a: float(not a),
    "isnan": lambda a: float(math.isnan(a)),
}
#: Those that may leave the numbers: NumPy gives infinity or NaN, as C does.
_PARTIAL: dict[str, Callable[..., Any]] = {
    "div": np.divide, "pow": np.power, "sqrt": np.sqrt, "exp": np.exp, "expm1": np.expm1,
    "log": np.log, "log1p": np.log1p, "sin": np.sin, "cos": np.cos, "tan": np.tan,
    "asin": np.arcsin, "acos": np.arccos, "atan": np.arctan, "atan2": np.arctan2,
    "sinh": np.sinh, "cosh": np.cosh, "tanh": np.tanh, "asinh": np.arcsinh,
    "acosh": np.arccosh, "atanh": np.arctanh, "hypot": np.hypot, "floor": np.floor,
    "erf": math.erf, "erfc": math.erfc,
}  # fmt: skip
_COMMUTATIVE = {"add", "mul", "min", "max", "and", "or", "eq", "ne"}


@dataclass
class Program:
    """Nodes by number: an operation and the numbers of its arguments.

    ``const`` holds a float, ``input`` a place; equal expressions are one node, and what only
    depends on constants is folded. A product with a constant 0 is 0.
    """

    nodes: list[tuple[object, ...]] = field(default_factory=list)
    known: dict[tuple[object, ...], int] = field(default_factory=dict)
    divisors: dict[int, int] = field(default_factory=dict)

    def _node(self, *key: object) -> int:
        if key not in self.known:
            if len(self.nodes) >= LARGEST:
                raise EngineError(
                    f"engine: found a step of more than {LARGEST} operations, expected fewer "
                    "(each iteration and each entry of a matrix is written out)"
                )
            self.known[key] = len(self.nodes)
            self.nodes.append(key)
        return self.known[key]

    def const(self, value: float) -> int:
        """A number."""
        value = float(value)
        if math.isnan(value) or (value == 0.0 and math.copysign(1.0, value) < 0.0):
            return self._node("const", repr(value))  # equal to no number, or to another one
        return self._node("const", value)

    def input(self, group: str, place: int) -> int:
        """An input: its group (constants, state, row) and place in it."""
        return self._node("input", group, place)

    def value(self, node: int) -> float | None:
        """The number of a constant node, else None."""
        op, *rest = self.nodes[node]
        if op != "const":
            return None
        return float(rest[0])  # type: ignore[arg-type]

    def make(self, op: str, *args: int) -> int:
        """The node of an operation, folded and shared."""
        values = [self.value(a) for a in args]
        simple = self._simplified(op, args, values)
        if simple is not None:
            return simple
        if op in _FOLD and all(v is not None for v in values):
            return self.const(_FOLD[op](*values))
        if op in _PARTIAL and all(v is not None for v in values):
            with np.errstate(all="ignore"):
                return self.const(_PARTIAL[op](*(np.float64(v) for v in values if v is not None)))
        if op in _COMMUTATIVE:
            args = tuple(sorted(args))
        return self._node(op, *args)

    def _simplified(
        self, op: str, args: tuple[int, ...], values: Sequence[float | None]
    ) -> int | None:
        if op == "select":
            if values[0] is not None:
                return args[1] if values[0] else args[2]
            return args[1] if args[1] == args[2] else None
        if op == "add":
            if values[0] == 0.0:
                return args[1]
            return args[0] if values[1] == 0.0 else None
        if op == "sub":
            if values[1] == 0.0:
                return args[0]
            return self.make("neg", args[1]) if values[0] == 0.0 else None
        if op == "mul":
            if 0.0 in values:
                return self.const(0.0)
            if values[0] == 1.0:
                return args[1]
            return args[0] if values[1] == 1.0 else None
        if op == "div":
            if values[1] == 1.0:
                return args[0]
            if values[0] == 0.0:
                return self.const(0.0)
            if values[0] == 1.0 or None not in values:
                return None
            return self._divided(*args)
        if op in ("min", "max") and args[0] == args[1]:
            return args[0]
        if op == "neg" and self.nodes[args[0]][0] == "neg":
            return self._argument(args[0])
        if op in BOOLEAN:
            return self._simplified_logic(op, args, values)
        return None

    def _simplified_logic(
        self, op: str, args: tuple[int, ...], values: Sequence[float | None]
    ) -> int | None:
        if op == "and":
            if 0.0 in values:
                return self.const(0.0)
            if values[0] == 1.0:
                return args[1]
            return args[0] if values[1] == 1.0 else None
        if op == "or":
            if 1.0 in values:
                return self.const(1.0)
            if values[0] == 0.0:
                return args[1]
            return args[0] if values[1] == 0.0 else None
        if op == "ne" and values[1] == 0.0 and self.nodes[args[0]][0] in BOOLEAN:
            return args[0]
        if op == "not" and self.nodes[args[0]][0] == "not":
            inner = self._argument(args[0])
            return inner if self.nodes[inner][0] in BOOLEAN else None
        return None

    def _divided(self, a: int, b: int) -> int | None:
        """The first division by a number is one; all others take its reciprocal."""
        one = self.const(1.0)
        if ("div", one, b) not in self.known and self.divisors.setdefault(b, a) == a:
            return None
        return self.make("mul", a, self.make("div", one, b))

    def _argument(self, node: int) -> int:
        """The first argument of a node."""
        argument = self.nodes[node][1]
        assert isinstance(argument, int)
        return argument

    @property
    def size(self) -> int:
        """How many nodes there are."""
        return len(self.nodes)

    def reciprocal(self, node: int) -> int | None:
        """The node of 1 / node, if there is one."""
        return self.known.get(("div", self.const(1.0), node))

    def arguments(self, node: int) -> tuple[int, ...]:
        """The nodes that an operation reads; none for a constant or an input."""
        op, *rest = self.nodes[node]
        return () if op in ("const", "input") else tuple(rest)  # type: ignore[arg-type]

    def live(self, outputs: Sequence[int]) -> list[int]:
        """Nodes that outputs need, in order."""
        needed, stack = set(), list(outputs)
        while stack:
            node = stack.pop()
            if node in needed:
                continue
            needed.add(node)
            stack.extend(self.arguments(node))
        return sorted(needed)
