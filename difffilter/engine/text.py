"""Single operations and numbers as C."""

from __future__ import annotations

from difffilter.engine.functions import CALLS, INLINE, power, whole

__all__ = ["expression", "is_number", "number"]

_INFIX = {"add": "+", "sub": "-", "mul": "*", "div": "/"}
_COMPARE = {"lt": "<", "le": "<=", "gt": ">", "ge": ">=", "eq": "==", "ne": "!="}


def expression(op: str, args: list[str]) -> str:
    """An operation as C."""
    if op in _INFIX:
        return f"{args[0]} {_INFIX[op]} {args[1]}"
    if op in _COMPARE:
        return f"{args[0]} {_COMPARE[op]} {args[1]} ? 1.0 : 0.0"
    exponent = whole(args[1]) if op == "pow" else None
    if exponent is not None:
        return power(args[0], exponent)
    if op in INLINE:
        return f"{INLINE[op]}({', '.join(args)})"
    if op in CALLS or op in ("sqrt", "floor"):
        return f"{op}({', '.join(args)})"
    if op == "neg":
        return f"-{args[0]}" if not args[0].startswith("-") else f"-({args[0]})"
    if op == "abs":
        return f"fabs({args[0]})"
    if op == "select":
        return f"{args[0]} != 0.0 ? {args[1]} : {args[2]}"
    if op == "and":
        return f"{args[0]} * {args[1]}"
    if op == "or":
        return f"{args[0]} + {args[1]} != 0.0 ? 1.0 : 0.0"
    if op == "not":
        return f"{args[0]} != 0.0 ? 0.0 : 1.0"
    if op == "isnan":
        return f"{args[0]} != {args[0]} ? 1.0 : 0.0"
    a, b = args
    sign = "<" if op == "min" else ">"
    # NaN goes on, as in torch.
    return f"({a} {sign} {b} || {a} != {a}) ? {a} : {b}"


def is_number(text: str) -> bool:
    """Whether a text is a number."""
    try:
        float(text.strip("()"))
    except ValueError:
        return False
    return True


def number(value: float | None) -> str:
    """A number as C, to the last digit."""
    assert value is not None
    if value != value:
        return "NAN"
    if value in (float("inf"), float("-inf")):
        return "INFINITY" if value > 0 else "(-INFINITY)"
    text = repr(float(value))
    return text if value >= 0 and not text.startswith("-") else f"({text})"
