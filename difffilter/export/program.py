"""A traced step as scalar C99 statements, with named constants and struct fields."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping, Sequence

from difffilter.engine.emit import expression, number
from difffilter.engine.program import Program
from difffilter.engine.trace import Layout

__all__ = ["element", "identifier", "statements"]

#: Operations that call a function; the macro of that name picks double or float.
CALLS = ("sqrt", "exp", "log", "log1p", "tanh", "sin", "cos", "floor", "atan2", "abs")


def identifier(text: str) -> str:
    """A C identifier for a dotted name."""
    name = re.sub(r"\W+", "_", text).strip("_")
    return name if name and not name[0].isdigit() else f"_{name}"


def element(name: str, shape: Sequence[int], place: int) -> str:
    """C text of one number of an array: row-major place to subscripts."""
    subscripts = []
    for size in reversed(shape):
        place, at = divmod(place, size)
        subscripts.append(f"[{at}]")
    return name + "".join(reversed(subscripts))


def statements(
    program: Program,
    outputs: Mapping[str, int],
    reading: Callable[[str, int], str],
) -> list[str]:
    """Lines that compute ``outputs``: C text of a place to its node.

    Args:
        reading: C text of an input, of its group and place.
    """
    wanted = list(outputs.values())
    lines = []

    def read(node: int) -> str:
        op, *rest = program.nodes[node]
        if op == "const":
            return _constant(program.value(node))
        if op == "input":
            return reading(str(rest[0]), int(str(rest[1])))
        return f"v{node}"

    for node in program.live(wanted):
        op = str(program.nodes[node][0])
        if op in ("const", "input"):
            continue
        args = [read(a) for a in program.arguments(node)]
        text = f"M_{op.upper()}({', '.join(args)})" if op in CALLS else expression(op, args)
        lines.append(f"    const REAL v{node} = {text};")
    return lines + [f"    {place} = {read(node)};" for place, node in outputs.items()]


def _constant(value: float | None) -> str:
    """A number; what depends on the precision by its name."""
    assert value is not None
    if value == sys.float_info.min:
        return "SMALLEST"
    ulps = value / sys.float_info.epsilon
    if 0.0 < ulps < 1e6 and ulps == int(ulps):
        return f"({int(ulps)} * EPSILON)"
    text = number(value)
    return text if "N" in text else f"(REAL){text}"


def places(layout: Layout, prefix: str, nodes: Sequence[int]) -> dict[str, int]:
    """C text of each number of a layout's arrays, and its node."""
    found, at = {}, 0
    for name, shape in layout.shapes.items():
        for i in range(layout.count(shape)):
            found[element(prefix + identifier(name), shape, i)] = nodes[at]
            at += 1
    return found


def names(layout: Layout, prefix: str) -> list[str]:
    """C text of each number of a layout's arrays, in order."""
    return [
        element(prefix + identifier(name), shape, i)
        for name, shape in layout.shapes.items()
        for i in range(layout.count(shape))
    ]
