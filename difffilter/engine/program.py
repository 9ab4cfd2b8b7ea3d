"""A scalar program: shared expressions over inputs, folded as they are made."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

__all__ = ["BOOLEAN", "Program"]

#: Operations whose value is a truth value.
BOOLEAN = {"lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "isnan"}

_FOLD: dict[str, Callable[..., float]] = {
    "add": lambda a, b: a + b,
    "sub": lambda a, b: a - b,
    "mul": lambda a, b: a * b,
    "min": lambda a, b: math.nan if math.isnan(a) or math.isnan(b) else min(a, b),
    "max": lambda a, b: math.nan if math.isnan(a) or math.isnan(b) else max(a, b),
    "atan2": math.atan2,
    "neg": lambda a: -a,
    "abs": abs,
    "exp": lambda a: math.exp(a) if a < 709.0 else math.inf,
    "log1p": math.log1p,
    "tanh": math.tanh,
    "sin": math.sin,
    "cos": math.cos,
    "floor": lambda a: float(math.floor(a)),
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
_COMMUTATIVE = {"add", "mul", "min", "max", "and", "or", "eq", "ne"}


@dataclass
class Program:
    """Nodes by number: an operation and the numbers of its arguments.

    ``const`` holds a float, ``input`` a place; equal expressions are one node, and what only
    depends on constants is folded. A product with a constant 0 is 0.
    """

    nodes: list[tuple[object, ...]] = field(default_factory=list)
    known: dict[tuple[object, ...], int] = field(default_factory=dict)

    def _node(self, *key: object) -> int:
        if key not in self.known:
            self.known[key] = len(self.nodes)
            self.nodes.append(key)
        return self.known[key]

    def const(self, value: float) -> int:
        """A number."""
        value = float(value)
        return self._node("const", "nan") if math.isnan(value) else self._node("const", value)

    def input(self, group: str, place: int) -> int:
        """An input: its group (constants, state, row) and place in it."""
        return self._node("input", group, place)

    def value(self, node: int) -> float | None:
        """The number of a constant node, else None."""
        op, *rest = self.nodes[node]
        if op != "const":
            return None
        return math.nan if rest[0] == "nan" else float(rest[0])  # type: ignore[arg-type]

    def make(self, op: str, *args: int) -> int:
        """The node of an operation, folded and shared."""
        values = [self.value(a) for a in args]
        simple = self._simplified(op, args, values)
        if simple is not None:
            return simple
        if op in _FOLD and all(v is not None for v in values):
            return self.const(_FOLD[op](*values))
        if op in ("div", "sqrt", "log") and all(v is not None for v in values):
            return self._folded_partial(op, [v for v in values if v is not None])
        if op in _COMMUTATIVE:
            args = tuple(sorted(args))
        return self._node(op, *args)

    def _folded_partial(self, op: str, values: Sequence[float]) -> int:
        a = values[0]
        if op == "div":
            b = values[1]
            if b != 0.0:
                return self.const(a / b)
            return self.const(math.nan if a == 0.0 or math.isnan(a) else math.copysign(math.inf, a))
        if a < 0.0 or math.isnan(a):
            return self.const(math.nan)
        if op == "sqrt":
            return self.const(math.sqrt(a))
        return self.const(math.log(a) if a > 0.0 else -math.inf)

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
            # One reciprocal serves all divisions by the same number, and their derivatives.
            return self.make("mul", args[0], self.make("div", self.const(1.0), args[1]))
        if op == "neg" and self.nodes[args[0]][0] == "neg":
            return self._argument(args[0])
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
        if op == "not" and self.nodes[args[0]][0] == "not":
            return self._argument(args[0])
        return None

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
