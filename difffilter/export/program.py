"""A traced step as scalar C99 statements, with named constants and struct fields."""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence

from difffilter.engine.program import BOOLEAN, Program
from difffilter.engine.trace import Layout

__all__ = ["element", "identifier", "identifiers", "literal", "names", "places", "statements"]

#: Operations that call a function; the macro of that name picks double or float.
CALLS = (
    "sqrt", "exp", "expm1", "log", "log1p", "sin", "cos", "tan", "asin", "acos", "atan", "atan2",
    "sinh", "cosh", "tanh", "asinh", "acosh", "atanh", "erf", "erfc", "pow", "hypot", "floor",
    "abs",
)  # fmt: skip
INFIX = {
    "add": "+", "sub": "-", "mul": "*", "div": "/",
    "lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!=",
}  # fmt: skip
KEYWORDS = (
    "auto", "break", "case", "char", "const", "continue", "default", "do", "double", "else",
    "enum", "extern", "float", "for", "goto", "if", "inline", "int", "long", "register",
    "restrict", "return", "short", "signed", "sizeof", "static", "struct", "switch", "typedef",
    "union", "unsigned", "void", "volatile", "while",
)  # fmt: skip
LEAST_FLOAT = 2.0**-126
#: What follows from the smallest normal number, or the largest one, of the precision.
LIMITS = {
    sys.float_info.min: "SMALLEST",
    math.sqrt(sys.float_info.min): "ROOT_SMALLEST",
    sys.float_info.max: "LARGEST",
    -sys.float_info.max: "-LARGEST",
}


def identifier(text: str) -> str:
    """A C identifier for a dotted name: ASCII, not reserved."""
    name = re.sub(r"\W+", "_", text, flags=re.ASCII).strip("_")
    return name if name and not name[0].isdigit() else f"f_{name}"


def identifiers(texts: Iterable[str], taken: Iterable[str] = ()) -> dict[str, str]:
    """An identifier for each name, none twice (in either case), no keyword, none of ``taken``."""
    used, found = {word.lower() for word in (*KEYWORDS, *taken)}, {}
    for text in texts:
        name = identifier(text)
        while name.lower() in used:
            name += "_"
        used.add(name.lower())
        found[text] = name
    return found


def element(name: str, shape: Sequence[int], place: int) -> str:
    """C text of one number of an array: row-major place to subscripts."""
    subscripts = []
    for size in reversed(shape):
        place, at = divmod(place, size)
        subscripts.append(f"[{at}]")
    return name + "".join(reversed(subscripts))


def statements(
    program: Program, outputs: Mapping[str, int], reading: Callable[[str, int], str]
) -> list[str]:
    """Lines that compute ``outputs``: C text of a place to its node.

    Args:
        reading: C text of an input, of its group and place.
    """

    def truth(node: int) -> bool:
        return program.nodes[node][0] in BOOLEAN

    def read(node: int) -> str:
        op, *rest = program.nodes[node]
        if op == "const":
            return literal(program.value(node))
        if op == "input":
            return reading(str(rest[0]), int(str(rest[1])))
        return f"v{node}"

    def number(node: int) -> str:
        return f"(REAL){read(node)}" if truth(node) else read(node)

    def condition(node: int) -> str:
        return read(node) if truth(node) else f"({read(node)} != ZERO)"

    lines = []
    for node in program.live(list(outputs.values())):
        op = str(program.nodes[node][0])
        if op in ("const", "input"):
            continue
        args = program.arguments(node)
        if op in ("select", "and", "or", "not"):
            text = _logical(op, condition(args[0]), args[1:], number, condition)
        else:
            text = _arithmetic(op, [number(a) for a in args])
        lines.append(f"    const {'int' if truth(node) else 'REAL'} v{node} = {text};")
    return lines + [f"    {place} = {number(node)};" for place, node in outputs.items()]


def _logical(
    op: str,
    first: str,
    rest: Sequence[int],
    number: Callable[[int], str],
    condition: Callable[[int], str],
) -> str:
    if op == "select":
        return f"{first} ? {number(rest[0])} : {number(rest[1])}"
    if op == "not":
        return f"!{first}"
    return f"{first} {'&&' if op == 'and' else '||'} {condition(rest[0])}"


def _arithmetic(op: str, args: Sequence[str]) -> str:
    if op in INFIX:
        return f"{args[0]} {INFIX[op]} {args[1]}"
    if op in CALLS:
        return f"C_{op.upper()}({', '.join(args)})"
    if op == "neg":
        return f"-({args[0]})" if args[0].startswith("-") else f"-{args[0]}"
    if op == "isnan":
        return f"{args[0]} != {args[0]}"
    a, b = args
    # NaN goes on, as in torch.
    return f"({a} {'<' if op == 'min' else '>'} {b} || {a} != {a}) ? {a} : {b}"


def literal(value: float | None) -> str:
    """A number as C of either precision, to the last digit; limits by their names."""
    assert value is not None
    if value != value:
        return "(REAL)NAN"
    if math.isinf(value):
        return "(REAL)INFINITY" if value > 0 else "-(REAL)INFINITY"
    if value in LIMITS:
        return LIMITS[value]
    ulps = value / sys.float_info.epsilon
    if 0.0 < ulps < 1e6 and ulps == int(ulps):
        return f"({int(ulps)} * EPSILON)"
    if 0.0 < value < LEAST_FLOAT:
        return f"TINY({value!r})"
    return f"(REAL){value!r}"


def places(
    layout: Layout, prefix: str, nodes: Sequence[int], known: Mapping[str, str]
) -> dict[str, int]:
    """C text of each number of a layout's arrays, and its node."""
    return dict(zip(names(layout, prefix, known), nodes, strict=True))


def names(layout: Layout, prefix: str, known: Mapping[str, str]) -> list[str]:
    """C text of each number of a layout's arrays, in order; ``known``: their identifiers."""
    return [
        element(prefix + known[name], shape, i)
        for name, shape in layout.shapes.items()
        for i in range(layout.count(shape))
    ]
