"""Derivatives of scalar operations: what a tangent is, as C."""

from __future__ import annotations

from collections.abc import Callable, Sequence

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
    if op == "div":  # 1 / b: the program divides by no other way
        own = keep(value(node))
        return f"-{own} * ({own} * {moved[args[1]]})"  # in this order: no inf * 0
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
    factors = {
        "sqrt": f"0.5 / {value(node)}",
        "exp": value(node),
        "log": f"1.0 / {a}",
        "log1p": f"1.0 / (1.0 + {a})",
        "tanh": f"1.0 - {value(node)} * {value(node)}",
        "sin": f"cos({a})",
        "cos": f"-sin({a})",
        "abs": f"({a} > 0.0 ? 1.0 : 0.0) - ({a} < 0.0 ? 1.0 : 0.0)",
    }
    return factors[op]


def _extreme(op: str, args: Sequence[int], value: Write, keep: Keep, moved: dict[int, str]) -> str:
    """That of the chosen argument; where both are equal the mean, or that of the active one."""
    a, b = args
    u, v = value(a), value(b)
    if a in moved and b in moved:
        sign = "<" if op == "min" else ">"
        share = keep(f"({u} {sign} {v} || {u} != {u}) ? 1.0 : ({u} == {v} ? 0.5 : 0.0)")
        x, y = moved[a], moved[b]
        return f"{share} == 1.0 ? {x} : {share} == 0.0 ? {y} : 0.5 * ({x} + {y})"
    active, u, v = (a, u, v) if a in moved else (b, v, u)
    sign = "<=" if op == "min" else ">="
    chosen = keep(f"({u} {sign} {v} || {u} != {u}) ? 1.0 : 0.0")
    return f"{chosen} != 0.0 ? {moved[active]} : 0.0"
