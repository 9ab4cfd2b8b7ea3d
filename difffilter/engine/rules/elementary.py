"""Roots, exponentials, logarithms, angles, the error function."""

from __future__ import annotations

import math
from typing import Any

from difffilter.engine.rules.table import Array, Lower, binary, rule, unary

__all__: list[str] = []

unary("sqrt", "exp", "log", "log1p", "expm1")
unary("sin", "cos", "tan", "asin", "acos", "atan")
unary("sinh", "cosh", "tanh", "asinh", "acosh", "atanh")
unary("erf", "erfc")
binary("atan2", "hypot")


@rule("rsqrt")
def _rsqrt(low: Lower, x: Any) -> Array:
    return low.map("div", 1.0, low.map("sqrt", x))


@rule("exp2")
def _exp2(low: Lower, x: Any) -> Array:
    return low.map("exp", low.map("mul", x, math.log(2.0)))


@rule("log2")
def _log2(low: Lower, x: Any) -> Array:
    return low.map("mul", low.map("log", x), 1.0 / math.log(2.0))


@rule("log10")
def _log10(low: Lower, x: Any) -> Array:
    return low.map("mul", low.map("log", x), 1.0 / math.log(10.0))


@rule("xlogy", "special_xlogy")
def _xlogy(low: Lower, x: Any, y: Any) -> Array:
    logarithm = low.map("log", y)
    wild = low.map("not", low.map("lt", low.map("abs", logarithm), math.inf))
    zero = low.map("and", low.map("eq", x, 0.0), wild)
    product = low.map("mul", x, low.map("select", zero, 0.0, logarithm))
    return low.map("select", low.map("isnan", y), y, product)


@rule("sinc")
def _sinc(low: Lower, x: Any) -> Array:
    angle = low.map("mul", x, math.pi)
    zero = low.map("eq", x, 0.0)
    ratio = low.map("div", low.map("sin", angle), low.map("select", zero, 1.0, angle))
    return low.map("select", zero, 1.0, ratio)


@rule("logaddexp")
def _logaddexp(low: Lower, a: Any, b: Any) -> Array:
    ahead = low.map("ge", a, b)
    top, rest = low.map("select", ahead, a, b), low.map("select", ahead, b, a)
    equal = low.map("eq", a, b)  # of two infinities too
    apart = low.map("select", equal, 0.0, low.map("sub", rest, top))
    grown = low.map("log1p", low.map("exp", apart))
    # A tie shares the derivative: half of each.
    middle = low.map("mul", low.map("add", a, b), 0.5)
    even = low.map("add", middle, math.log(2.0))
    return low.map("select", equal, even, low.map("add", top, grown))


@rule("deg2rad")
def _deg2rad(low: Lower, x: Any) -> Array:
    return low.map("mul", x, math.pi / 180.0)


@rule("rad2deg")
def _rad2deg(low: Lower, x: Any) -> Array:
    return low.map("mul", x, 180.0 / math.pi)
