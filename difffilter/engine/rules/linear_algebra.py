"""Small linear systems: triangular, general with pivots, positive definite."""

from __future__ import annotations

from typing import Any

import numpy as np

from difffilter.engine.rules.table import Array, Lower, array, rule

__all__: list[str] = []


@rule("linalg_solve_triangular")
def _solve_triangular(
    low: Lower, a: Array, b: Array, *, upper: bool, left: bool = True, unitriangular: bool = False
) -> Array:
    if not left:
        a, b = np.swapaxes(a, -1, -2), np.swapaxes(b, -1, -2)
        made = _solve_triangular(low, a, b, upper=not upper, unitriangular=unitriangular)
        return np.swapaxes(made, -1, -2)
    n = a.shape[-1]
    rows: list[Any] = [None] * n
    for i in range(n - 1, -1, -1) if upper else range(n):
        right = b[..., i, :]
        for j in range(n):
            if rows[j] is not None:
                right = low.map("sub", right, low.map("mul", a[..., i, j, None], rows[j]))
        rows[i] = right if unitriangular else low.map("div", right, a[..., i, i, None])
    return np.stack(np.broadcast_arrays(*rows), axis=-2)


def _factored(low: Lower, a: Array) -> tuple[Array, Array, Array]:
    """L and U in one, the order of the rows, its sign: the largest pivot of each column."""
    n, lead = a.shape[-1], a.shape[:-2]
    order = low.constant(np.broadcast_to(np.arange(n, dtype=float), (*lead, n)).copy())
    sign = low.constant(np.ones(lead))
    table = np.concatenate([array(a), order[..., None]], axis=-1)
    for i in range(n):
        for j in range(i + 1, n):
            swap = low.map("gt", low.map("abs", table[..., j, i]), low.map("abs", table[..., i, i]))
            sign = low.map("select", swap, low.map("neg", sign), sign)
            above, below = table[..., i, :].copy(), table[..., j, :].copy()
            table[..., i, :] = low.map("select", swap[..., None], below, above)
            table[..., j, :] = low.map("select", swap[..., None], above, below)
        for j in range(i + 1, n):
            factor = low.map("div", table[..., j, i], table[..., i, i])[..., None]
            rest = low.map("mul", factor, table[..., i, i + 1 : n])
            table[..., j, i + 1 : n] = low.map("sub", table[..., j, i + 1 : n], rest)
            table[..., j, i] = factor[..., 0]
    return table[..., :n], table[..., n], sign


def _solved(low: Lower, lu: Array, order: Array, b: Array) -> Array:
    """The columns of X in A X = B."""
    n = lu.shape[-1]
    rows = []
    for i in range(n):
        made = b[..., 0, :]
        for j in range(1, n):
            here = low.map("eq", order[..., i], float(j))[..., None]
            made = low.map("select", here, b[..., j, :], made)
        rows.append(made)
    moved = np.stack(np.broadcast_arrays(*rows), axis=-2)
    lower = _solve_triangular(low, lu, moved, upper=False, unitriangular=True)
    return _solve_triangular(low, lu, lower, upper=True)


@rule("linalg_lu_factor_ex")
def _lu_factor(low: Lower, a: Array, **_: Any) -> tuple[Any, ...]:
    """The order of the rows stands where LAPACK has its exchanges."""
    lu, order, _sign = _factored(low, a)
    return lu, order, None


@rule("linalg_lu_solve")
def _lu_solve(
    low: Lower, lu: Array, order: Array, b: Array, *, left: bool = True, adjoint: bool = False
) -> Array:
    if not left:
        b = np.swapaxes(b, -1, -2)
        made = _lu_solve(low, lu, order, b, adjoint=not adjoint)
        return np.swapaxes(made, -1, -2)
    if not adjoint:
        return _solved(low, lu, order, b)
    across, n = np.swapaxes(lu, -1, -2), lu.shape[-1]
    made = _solve_triangular(low, across, b, upper=False)
    made = _solve_triangular(low, across, made, upper=True, unitriangular=True)
    rows = []
    for j in range(n):  # row j of the result is the one that stands at j's place
        row = made[..., 0, :]
        for i in range(1, n):
            here = low.map("eq", order[..., i], float(j))[..., None]
            row = low.map("select", here, made[..., i, :], row)
        rows.append(row)
    return np.stack(np.broadcast_arrays(*rows), axis=-2)


@rule("linalg_solve_ex")
def _solve(
    low: Lower, a: Array, b: Array, *, left: bool = True, check_errors: bool = False
) -> tuple[Any, ...]:
    """Also L and U, and the order of the rows, which derivatives read."""
    vector = b.ndim == 1 or (b.ndim == a.ndim - 1 and b.shape == a.shape[:-1])
    lu, order, _sign = _factored(low, a)
    x = _lu_solve(low, lu, order, b[..., None] if vector else b, left=left or vector)
    return (x[..., 0] if vector else x), lu, order, None


@rule("linalg_inv_ex")
def _inverse(low: Lower, a: Array, **_: Any) -> tuple[Any, ...]:
    lu, order, _sign = _factored(low, a)
    return _solved(low, lu, order, low.constant(np.eye(a.shape[-1]))), None


@rule("linalg_det")
def _determinant(low: Lower, a: Array) -> tuple[Any, ...]:
    lu, order, sign = _factored(low, a)
    for i in range(a.shape[-1]):
        sign = low.map("mul", sign, lu[..., i, i])
    return sign, lu, order


@rule("linalg_slogdet")
def _log_determinant(low: Lower, a: Array) -> tuple[Any, ...]:
    found, lu, order = _determinant(low, a)
    total = low.constant(np.zeros(found.shape))
    for i in range(a.shape[-1]):
        total = low.map("add", total, low.map("log", low.map("abs", lu[..., i, i])))
    sign = low.map("sub", low.map("gt", found, 0.0), low.map("lt", found, 0.0))
    return sign, total, lu, order


@rule("linalg_cholesky_ex")
def _cholesky(
    low: Lower, a: Array, *, upper: bool = False, check_errors: bool = False
) -> tuple[Array, Array]:
    """L, and whether a pivot was not above zero (LAPACK tells which one was first)."""
    n = a.shape[-1]
    made = low.constant(np.zeros(a.shape))
    failed = low.constant(np.zeros(a.shape[:-2]))
    for j in range(n):
        for i in range(j, n):
            rest = a[..., j, i] if upper else a[..., i, j]
            for k in range(j):
                rest = low.map("sub", rest, low.map("mul", made[..., i, k], made[..., j, k]))
            if i == j:
                failed = low.map("or", failed, low.map("not", low.map("gt", rest, 0.0)))
                made[..., j, j] = low.map("sqrt", rest)
            else:
                made[..., i, j] = low.map("div", rest, made[..., j, j])
    return (np.swapaxes(made, -1, -2) if upper else made), failed


@rule("cholesky_solve", "cholesky_solve_helper")
def _cholesky_solve(low: Lower, b: Array, factor: Array, upper: bool = False) -> Array:
    lower = np.swapaxes(factor, -1, -2) if upper else factor
    half = _solve_triangular(low, lower, b, upper=False)
    return _solve_triangular(low, np.swapaxes(lower, -1, -2), half, upper=True)


@rule("cholesky_inverse")
def _cholesky_inverse(low: Lower, factor: Array, upper: bool = False) -> Array:
    return _cholesky_solve(low, low.constant(np.eye(factor.shape[-1])), factor, upper)
