"""Derivatives of scalar operations: what a tangent is, as C."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from difffilter.engine.functions import power, whole

__all__ = ["tangent"]

Write = Callable[[int], str]
Keep = Callable[[str], str]


def tangent(
    op: str,
    node: int,
    args: Sequence[int],
    value: Write,
    keep: Keep,
    moved: dict[int, str],
    inverse: str | None = None,
) -> str:
    """C expression of an operation's tangent.

    Args:
        op, node, args: the operation, and the nodes of its result and arguments.
        value: the text of a node's value in the loop of values.
        keep: asks that loop to keep an expression; returns its name in the loop of tangents.
        moved: the tangents of those arguments that have one.
        inverse: the value of 1 / result, where it is at hand.
    """
    if op == "select":
        chosen = keep(value(args[0]))
        return f"{chosen} != 0.0 ? {moved.get(args[1], '0.0')} : {moved.get(args[2], '0.0')}"
    if op in ("min", "max"):
        return _extreme(op, args, value, keep, moved)
    if op == "div":
        return _quotient(node, args, value, keep, moved)
    terms = []
    for at, argument in enumerate(args):
        if argument in moved:
            factor = _factor(op, at, node, args, value)
            if op == "sqrt" and inverse:
                factor = f"0.5 * {inverse}"
            if factor in ("1", "-1"):
                terms.append(("-" if factor == "-1" else "") + moved[argument])
            else:
                terms.append(f"{keep(factor)} * {moved[argument]}")
    return " + ".join(terms).replace("+ -", "- ")


def _factor(op: str, at: int, node: int, args: Sequence[int], value: Write) -> str:
    """The partial derivative towards argument ``at``; "1" and "-1" stand for themselves."""
    a = value(args[0])
    b = value(args[1]) if len(args) > 1 else ""
    if op in ("add", "sub", "neg"):
        return "-1" if op == "neg" or (op == "sub" and at == 1) else "1"
    if op == "mul":
        return a if at == 1 else b
    if op == "atan2":
        square = f"({a} * {a} + {b} * {b})"
        return f"{b} / {square}" if at == 0 else f"-{a} / {square}"
    if op == "hypot":
        return f"{b if at else a} / {value(node)}"
    if op == "pow":
        return _power(at, a, b, value(node))
    return SLOPES[op].format(a=a, v=value(node))


#: Of an argument a and the result v.
SLOPES = {
    "sqrt": "0.5 / {v}",
    "exp": "{v}",
    "expm1": "x_exp({a})",
    "log": "1.0 / {a}",
    "log1p": "1.0 / (1.0 + {a})",
    "sin": "cos({a})",
    "cos": "-sin({a})",
    "tan": "1.0 + {v} * {v}",
    "asin": "1.0 / sqrt(1.0 - {a} * {a})",
    "acos": "-1.0 / sqrt(1.0 - {a} * {a})",
    "atan": "1.0 / (1.0 + {a} * {a})",
    "sinh": "cosh({a})",
    "cosh": "sinh({a})",
    "tanh": "1.0 - {v} * {v}",
    "asinh": "1.0 / sqrt({a} * {a} + 1.0)",
    "acosh": "1.0 / sqrt({a} * {a} - 1.0)",
    "atanh": "1.0 / (1.0 - {a} * {a})",
    "erf": "1.1283791670955126 * x_exp(-{a} * {a})",
    "erfc": "-1.1283791670955126 * x_exp(-{a} * {a})",
    "abs": "({a} > 0.0 ? 1.0 : 0.0) - ({a} < 0.0 ? 1.0 : 0.0)",
}


def _quotient(
    node: int, args: Sequence[int], value: Write, keep: Keep, moved: dict[int, str]
) -> str:
    """(da - v db) / b; of a reciprocal -v (v db), in this order: no inf * 0."""
    a, b = args
    own = keep(value(node))
    if a not in moved and value(a) == "1.0":
        return f"-{own} * ({own} * {moved[b]})"
    inverse = keep(f"1.0 / {value(b)}")
    top = [moved[a]] if a in moved else []
    top += [f"- {own} * {moved[b]}"] if b in moved else []
    return f"({' '.join(top)}) * {inverse}"


def _power(at: int, a: str, b: str, own: str) -> str:
    """b a^(b - 1), or v log a; as torch has them at 0."""
    if at == 1:
        return f"({a} == 0.0 && {b} >= 0.0) ? 0.0 : {own} * x_log({a})"
    exponent = whole(b)
    if exponent is not None:
        return f"{b} * {power(a, exponent - 1)}"
    return f"{b} == 0.0 ? 0.0 : {b} * x_pow({a}, {b} - 1.0)"


def _extreme(op: str, args: Sequence[int], value: Write, keep: Keep, moved: dict[int, str]) -> str:
    """That of the chosen argument; where both are equal the mean."""
    a, b = args
    u, v = value(a), value(b)
    if a in moved and b in moved:
        sign = "<" if op == "min" else ">"
        share = keep(f"{u} {sign} {v} ? 1.0 : ({u} == {v} ? 0.5 : 0.0)")
        x, y = moved[a], moved[b]
        return f"{share} == 1.0 ? {x} : {share} == 0.0 ? {y} : 0.5 * ({x} + {y})"
    active, u, v = (a, u, v) if a in moved else (b, v, u)
    sign = "<" if op == "min" else ">"
    share = keep(f"{u} {sign} {v} ? 1.0 : ({u} == {v} ? 0.5 : 0.0)")
    return f"{share} != 0.0 ? {share} * {moved[active]} : 0.0"
