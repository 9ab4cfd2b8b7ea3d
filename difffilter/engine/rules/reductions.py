"""Sums, means, extremes, medians, norms along dimensions."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from difffilter.engine.rules.table import Array, Lower, array, rule

__all__ = ["axes_of"]


def axes_of(x: Array, dims: Any) -> list[int]:
    """Dimensions as a list; all of them for None or an empty list."""
    if dims is None or (isinstance(dims, (list, tuple)) and not dims):
        return list(range(x.ndim))
    return [d % max(x.ndim, 1) for d in ([dims] if isinstance(dims, int) else dims)]


@rule("sum")
def _sum(low: Lower, x: Array, dim: Any = None, keepdim: bool = False, dtype: Any = None) -> Array:
    return low.fold("add", x, axes_of(x, dim), keepdim)


@rule("mean")
def _mean(low: Lower, x: Array, dim: Any = None, keepdim: bool = False, dtype: Any = None) -> Array:
    total = low.fold("add", x, axes_of(x, dim), keepdim)
    return low.map("div", total, float(x.size // max(total.size, 1)))


@rule("prod")
def _prod(low: Lower, x: Array, dim: Any = None, keepdim: bool = False, dtype: Any = None) -> Array:
    return low.fold("mul", x, axes_of(x, dim), keepdim)


@rule("cumsum")
def _cumsum(low: Lower, x: Array, dim: int, dtype: Any = None) -> Array:
    return _running(low, "add", x, dim)


@rule("cumprod")
def _cumprod(low: Lower, x: Array, dim: int, dtype: Any = None) -> Array:
    return _running(low, "mul", x, dim)


def _running(low: Lower, op: str, x: Array, dim: int) -> Array:
    if x.ndim == 0:
        return x
    rows = [array(part) for part in np.moveaxis(x, dim, 0)]
    for i in range(1, len(rows)):
        rows[i] = low.map(op, rows[i - 1], rows[i])
    return np.stack(rows, axis=dim)


@rule("var")
def _var(
    low: Lower, x: Array, dim: Any = None, correction: float | None = None, keepdim: bool = False
) -> Array:
    axes = axes_of(x, dim)
    count = math.prod(x.shape[a] for a in axes)
    apart = low.map("sub", x, _mean(low, x, axes, True))
    total = low.fold("add", low.map("mul", apart, apart), axes, keepdim)
    return low.map("div", total, float(count - (1 if correction is None else correction)))


@rule("std")
def _std(
    low: Lower, x: Array, dim: Any = None, correction: float | None = None, keepdim: bool = False
) -> Array:
    """The derivative where all are equal is 0, as torch has it."""
    variance = _var(low, x, dim, correction, keepdim)
    zero = low.map("eq", variance, 0.0)
    root = low.map("sqrt", low.map("select", zero, 1.0, variance))
    return low.map("select", zero, 0.0, root)


@rule("amax")
def _amax(low: Lower, x: Array, dim: Any = None, keepdim: bool = False) -> Array:
    return low.fold("max", x, axes_of(x, dim), keepdim)


@rule("amin")
def _amin(low: Lower, x: Array, dim: Any = None, keepdim: bool = False) -> Array:
    return low.fold("min", x, axes_of(x, dim), keepdim)


@rule("max")
def _max(low: Lower, x: Array, dim: Any = None, keepdim: bool = False) -> Any:
    return low.fold("max", x, None, False) if dim is None else _chosen(low, "gt", x, dim, keepdim)


@rule("min")
def _min(low: Lower, x: Array, dim: Any = None, keepdim: bool = False) -> Any:
    return low.fold("min", x, None, False) if dim is None else _chosen(low, "lt", x, dim, keepdim)


@rule("argmax")
def _argmax(low: Lower, x: Array, dim: Any = None, keepdim: bool = False) -> Array:
    x, dim = (x.reshape(-1), 0) if dim is None else (x, dim)
    return _chosen(low, "gt", x, dim, keepdim)[1]


@rule("argmin")
def _argmin(low: Lower, x: Array, dim: Any = None, keepdim: bool = False) -> Array:
    x, dim = (x.reshape(-1), 0) if dim is None else (x, dim)
    return _chosen(low, "lt", x, dim, keepdim)[1]


def _chosen(low: Lower, better: str, x: Array, dim: int, keepdim: bool) -> tuple[Array, Array]:
    """The first best entry along a dimension (NaN before all), and its place."""
    rows = [array(row) for row in np.moveaxis(np.atleast_1d(x), dim, 0)]
    best, place = rows[0], low.constant(np.zeros(rows[0].shape))
    for i, row in enumerate(rows[1:], start=1):
        not_yet = low.map("not", low.map("isnan", best))
        ahead = low.map("or", low.map(better, row, best), low.map("isnan", row))
        taken = low.map("and", not_yet, ahead)
        best = low.map("select", taken, row, best)
        place = low.map("select", taken, float(i), place)
    if keepdim and x.ndim:
        best, place = np.expand_dims(best, dim), np.expand_dims(place, dim)
    return best, place


@rule("any")
def _any(low: Lower, x: Array, dim: Any = None, keepdim: bool = False) -> Array:
    return low.fold("or", low.map("ne", x, 0.0), axes_of(x, dim), keepdim)


@rule("all")
def _all(low: Lower, x: Array, dim: Any = None, keepdim: bool = False) -> Array:
    if not x.size:
        return low.map("not", low.fold("or", x, axes_of(x, dim), keepdim))
    return low.fold("and", low.map("ne", x, 0.0), axes_of(x, dim), keepdim)


@rule("softmax")
def _softmax(low: Lower, x: Array, dim: int, half: bool = False) -> Array:
    top = low.fold("max", x, dim, True)
    grown = low.map("exp", low.map("sub", x, top))
    return low.map("div", grown, low.fold("add", grown, dim, True))


@rule("log_softmax")
def _log_softmax(low: Lower, x: Array, dim: int, half: bool = False) -> Array:
    moved = low.map("sub", x, low.fold("max", x, dim, True))
    total = low.fold("add", low.map("exp", moved), dim, True)
    return low.map("sub", moved, low.map("log", total))


@rule("logsumexp")
def _logsumexp(low: Lower, x: Array, dim: Any, keepdim: bool = False) -> Array:
    axes = axes_of(x, dim)
    top = low.fold("max", x, axes, True)
    top = low.map("select", low.map("lt", low.map("abs", top), np.inf), top, 0.0)
    total = low.fold("add", low.map("exp", low.map("sub", x, top)), axes, keepdim)
    kept = top if keepdim else np.squeeze(top, tuple(axes))
    return low.map("add", low.map("log", total), kept)


@rule("linalg_vector_norm")
def _vector_norm(
    low: Lower, x: Array, ord: float = 2, dim: Any = None, keepdim: bool = False, dtype: Any = None
) -> Array:
    """Norms; of a zero vector the derivative is 0, as torch has it."""
    axes, size = axes_of(x, dim), low.map("abs", x)
    if math.isinf(ord):
        return low.fold("max" if ord > 0 else "min", size, axes, keepdim)
    if ord == 0:
        return low.fold("add", low.map("ne", x, 0.0), axes, keepdim)
    if ord == 1:
        return low.fold("add", size, axes, keepdim)
    powers = low.map("mul", x, x) if ord == 2 else low.map("pow", size, float(ord))
    total = low.fold("add", powers, axes, keepdim)
    zero = low.map("eq", total, 0.0)
    safe = low.map("select", zero, 1.0, total)
    root = low.map("sqrt", safe) if ord == 2 else low.map("pow", safe, 1.0 / ord)
    return low.map("select", zero, 0.0, root)


@rule("nanmedian")
def _nanmedian(low: Lower, x: Array, dim: int, keepdim: bool = False) -> tuple[Array, Array]:
    """The lower median of what is not NaN: a sorting network with NaN last."""
    rows = [array(row) for row in np.moveaxis(x, dim, 0)]
    count = low.constant(0.0)
    for row in rows:
        count = low.map("add", count, low.map("not", low.map("isnan", row)))
    rows = [low.map("select", low.map("isnan", r), np.inf, r) for r in rows]
    for i in range(len(rows)):
        for j in range(i % 2, len(rows) - 1, 2):
            least = low.map("min", rows[j], rows[j + 1])
            rows[j + 1] = low.map("max", rows[j], rows[j + 1])
            rows[j] = least
    found = low.constant(np.full(rows[0].shape, np.nan))
    for i, row in enumerate(rows):  # entry (count - 1) // 2
        inside = low.map(
            "and", low.map("ge", count, 2.0 * i + 1.0), low.map("le", count, 2.0 * i + 2.0)
        )
        found = low.map("select", inside, row, found)
    found = np.expand_dims(found, dim) if keepdim else found
    return found, found
