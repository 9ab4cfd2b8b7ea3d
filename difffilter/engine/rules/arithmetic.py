"""Sums, products, quotients, powers, remainders, bounds."""

from __future__ import annotations

from typing import Any

import numpy as np

from difffilter.engine.rules.table import Array, Lower, binary, rule, unary

__all__ = ["clamp", "floor_division", "power", "truncated"]

unary("neg", "abs", "floor")


@rule("add")
def _add(low: Lower, a: Any, b: Any, alpha: float = 1) -> Array:
    return low.map("add", a, b if alpha == 1 else low.map("mul", b, alpha))


@rule("sub", "subtract")
def _sub(low: Lower, a: Any, b: Any, alpha: float = 1) -> Array:
    return low.map("sub", a, b if alpha == 1 else low.map("mul", b, alpha))


@rule("rsub")
def _rsub(low: Lower, a: Any, b: Any, alpha: float = 1) -> Array:
    return _sub(low, b, a, alpha)


binary("mul")


@rule("div", "divide", "true_divide")
def _div(low: Lower, a: Any, b: Any, rounding_mode: str | None = None) -> Array:
    if rounding_mode == "floor":
        return floor_division(low, a, b)
    quotient = low.map("div", a, b)
    return quotient if rounding_mode is None else truncated(low, quotient)


@rule("floor_divide")
def floor_division(low: Lower, a: Any, b: Any) -> Array:
    """The whole k with a = k b + remainder, as torch rounds it."""
    return low.map("floor", low.map("div", a, b))


@rule("reciprocal")
def _reciprocal(low: Lower, x: Any) -> Array:
    return low.map("div", 1.0, x)


@rule("addcmul")
def _addcmul(low: Lower, a: Any, b: Any, c: Any, value: float = 1) -> Array:
    product = low.map("mul", b, c)
    if value == -1:
        return low.map("sub", a, product)
    return low.map("add", a, product if value == 1 else low.map("mul", product, value))


@rule("addcdiv")
def _addcdiv(low: Lower, a: Any, b: Any, c: Any, value: float = 1) -> Array:
    return low.map("add", a, low.map("mul", low.map("div", b, c), value))


@rule("lerp")
def _lerp(low: Lower, a: Any, b: Any, weight: Any) -> Array:
    return low.map("add", a, low.map("mul", weight, low.map("sub", b, a)))


@rule("square")
def _square(low: Lower, x: Any) -> Array:
    return low.map("mul", x, x)


@rule("pow")
def power(low: Lower, a: Any, b: Any) -> Array:
    """a^b; the exponents that torch computes otherwise, otherwise too."""
    if not isinstance(b, (int, float)):
        return low.map("pow", a, b)
    if b == 0:
        return low.constant(np.ones(np.shape(a)))
    if b == 1:
        return low.of(a)
    if b == 2:
        return low.map("mul", a, a)
    if b == 0.5:
        return low.map("sqrt", a)
    if b == -0.5:
        return low.map("div", 1.0, low.map("sqrt", a))
    if b == -1:
        return low.map("div", 1.0, a)
    return low.map("pow", a, float(b))


@rule("remainder")
def _remainder(low: Lower, a: Any, b: Any) -> Array:
    """Of the sign of b. The quotient's rounding may be off by one: put right."""
    times = low.map("floor", low.map("div", a, b))
    left = low.map("sub", a, low.map("mul", times, b))
    left = low.map("select", low.map("eq", times, 0.0), a, left)  # of an infinite b too
    positive, negative = low.map("gt", b, 0.0), low.map("lt", b, 0.0)
    under = low.map(
        "or",
        low.map("and", positive, low.map("lt", left, 0.0)),
        low.map("and", negative, low.map("gt", left, 0.0)),
    )
    over = low.map(
        "or",
        low.map("and", positive, low.map("gt", left, b)),
        low.map("and", negative, low.map("lt", left, b)),
    )
    left = low.map("select", over, low.map("sub", left, b), left)
    return low.map("select", under, low.map("add", left, b), left)


@rule("fmod")
def _fmod(low: Lower, a: Any, b: Any) -> Array:
    """Of the sign of a."""
    size = low.map("abs", b)
    under = low.map("neg", _remainder(low, low.map("neg", a), size))
    return low.map("select", low.map("lt", a, 0.0), under, _remainder(low, a, size))


@rule("trunc", "fix")
def truncated(low: Lower, x: Any) -> Array:
    """Without what follows the point."""
    down = low.map("floor", x)
    up = low.map("neg", low.map("floor", low.map("neg", x)))
    return low.map("select", low.map("lt", x, 0.0), up, down)


@rule("ceil")
def _ceil(low: Lower, x: Any) -> Array:
    return low.map("neg", low.map("floor", low.map("neg", x)))


@rule("frac")
def _frac(low: Lower, x: Any) -> Array:
    return low.map("sub", x, truncated(low, x))


@rule("round")
def _round(low: Lower, x: Any) -> Array:
    """To the nearest, halves to the even one."""
    down = low.map("floor", x)
    part = low.map("sub", x, down)
    half = low.map("mul", down, 0.5)
    odd = low.map("ne", low.map("floor", half), half)
    up = low.map("or", low.map("gt", part, 0.5), low.map("and", low.map("eq", part, 0.5), odd))
    return low.map("select", up, low.map("add", down, 1.0), down)


@rule("clamp", "clip")
def clamp(low: Lower, x: Any, low_bound: Any = None, high_bound: Any = None, **named: Any) -> Array:
    """Bounded; at a bound the derivative is that of x."""
    least, most = named.get("min", low_bound), named.get("max", high_bound)
    if least is not None:
        x = low.map("select", low.map("lt", x, least), least, x)
    return x if most is None else low.map("select", low.map("gt", x, most), most, x)


@rule("clamp_min")
def _clamp_min(low: Lower, x: Any, least: Any) -> Array:
    return clamp(low, x, least)


@rule("clamp_max")
def _clamp_max(low: Lower, x: Any, most: Any) -> Array:
    return clamp(low, x, None, most)


@rule("maximum")
def _maximum(low: Lower, a: Any, b: Any) -> Array:
    return low.map("max", a, b)


@rule("minimum")
def _minimum(low: Lower, a: Any, b: Any) -> Array:
    return low.map("min", a, b)


@rule("fmax")
def _fmax(low: Lower, a: Any, b: Any) -> Array:
    """The larger one, NaN left out; the derivative at a tie as torch has it."""
    mine = low.map("or", low.map("gt", a, b), low.map("isnan", b))
    return low.map("select", mine, a, b)


@rule("fmin")
def _fmin(low: Lower, a: Any, b: Any) -> Array:
    mine = low.map("or", low.map("le", a, b), low.map("isnan", b))
    return low.map("select", mine, a, b)
