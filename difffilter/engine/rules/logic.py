"""Comparisons, truth values, choices, and what is not a number."""

from __future__ import annotations

from typing import Any

import numpy as np

from difffilter.engine.rules.table import Array, Lower, binary, rule, unary

__all__: list[str] = []

binary("lt", "le", "gt", "ge", "eq", "ne")
unary("isnan")


@rule("where")
def _where(low: Lower, c: Any, a: Any, b: Any) -> Array:
    return low.map("select", c, a, b)


@rule("masked_fill")
def _masked_fill(low: Lower, x: Any, mask: Any, value: Any) -> Array:
    return low.map("select", mask, value, x)


@rule("bitwise_and", "logical_and")
def _and(low: Lower, a: Any, b: Any) -> Array:
    return low.map("and", _truth(low, a), _truth(low, b))


@rule("bitwise_or", "logical_or")
def _or(low: Lower, a: Any, b: Any) -> Array:
    return low.map("or", _truth(low, a), _truth(low, b))


@rule("bitwise_xor", "logical_xor")
def _xor(low: Lower, a: Any, b: Any) -> Array:
    return low.map("ne", _truth(low, a), _truth(low, b))


@rule("bitwise_not", "logical_not")
def _not(low: Lower, a: Any) -> Array:
    return low.map("not", a)


@rule("isfinite")
def _isfinite(low: Lower, x: Any) -> Array:
    return low.map("lt", low.map("abs", x), np.inf)


@rule("isinf")
def _isinf(low: Lower, x: Any) -> Array:
    return low.map("eq", low.map("abs", x), np.inf)


@rule("isposinf")
def _isposinf(low: Lower, x: Any) -> Array:
    return low.map("eq", x, np.inf)


@rule("isneginf")
def _isneginf(low: Lower, x: Any) -> Array:
    return low.map("eq", x, -np.inf)


@rule("sign", "sgn")
def _sign(low: Lower, x: Any) -> Array:
    return low.map("sub", low.map("gt", x, 0.0), low.map("lt", x, 0.0))


@rule("signbit")
def _signbit(low: Lower, x: Any) -> Array:
    return _negative(low, x)


@rule("copysign")
def _copysign(low: Lower, a: Any, b: Any) -> Array:
    size = low.map("abs", a)
    return low.map("select", _negative(low, b), low.map("neg", size), size)


@rule("heaviside")
def _heaviside(low: Lower, x: Any, at_zero: Any) -> Array:
    above = low.map("select", low.map("isnan", x), x, low.map("gt", x, 0.0))
    return low.map("select", low.map("eq", x, 0.0), at_zero, above)


@rule("nan_to_num")
def _nan_to_num(
    low: Lower, x: Any, nan: Any = None, posinf: Any = None, neginf: Any = None
) -> Array:
    largest = float(np.finfo(np.float64).max)
    most = largest if posinf is None else posinf
    least = -largest if neginf is None else neginf
    found = low.map("select", low.map("eq", x, np.inf), most, x)
    found = low.map("select", low.map("eq", x, -np.inf), least, found)
    return low.map("select", low.map("isnan", x), 0.0 if nan is None else nan, found)


def _truth(low: Lower, x: Any) -> Array:
    """0 or 1."""
    return low.map("ne", x, 0.0)


def _negative(low: Lower, x: Any) -> Array:
    """Whether the sign is minus, that of zero included."""
    zero = low.map("and", low.map("eq", x, 0.0), low.map("lt", low.map("div", 1.0, x), 0.0))
    return low.map("or", low.map("lt", x, 0.0), zero)
