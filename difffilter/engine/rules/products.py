"""Products of vectors and matrices."""

from __future__ import annotations

from typing import Any

import numpy as np

from difffilter.engine.rules.table import Array, Lower, array, rule

__all__ = ["matmul"]


@rule("mm", "bmm", "matmul")
def matmul(low: Lower, a: Array, b: Array) -> Array:
    """A B over leading dimensions; vectors as in torch."""
    left, right = a.ndim == 1, b.ndim == 1
    a, b = (a[None] if left else a), (b[:, None] if right else b)
    product = low.map("mul", a[..., None], b[..., None, :, :])
    made = low.fold("add", product, product.ndim - 2, False)
    made = made[..., 0, :] if left else made
    return made[..., 0] if right else made


@rule("mv")
def _mv(low: Lower, a: Array, b: Array) -> Array:
    return low.fold("add", low.map("mul", a, b), 1, False)


@rule("dot", "vdot")
def _dot(low: Lower, a: Array, b: Array) -> Array:
    return low.fold("add", low.map("mul", a, b), 0, False)


@rule("addmm", "addmv", "baddbmm")
def _addmm(low: Lower, x: Any, a: Array, b: Array, beta: float = 1, alpha: float = 1) -> Array:
    product = matmul(low, a, b)
    product = product if alpha == 1 else low.map("mul", product, alpha)
    return low.map("add", x if beta == 1 else low.map("mul", x, beta), product)


@rule("linear")
def _linear(low: Lower, x: Array, weight: Array, bias: Any = None) -> Array:
    product = matmul(low, x, np.swapaxes(weight, -1, -2) if weight.ndim > 1 else weight)
    return product if bias is None else low.map("add", product, bias)


@rule("linalg_cross")
def _cross(low: Lower, a: Array, b: Array, dim: int = -1) -> Array:
    a, b = np.broadcast_arrays(a, b)
    a, b = np.moveaxis(a, dim, 0), np.moveaxis(b, dim, 0)
    rows = [
        low.map(
            "sub",
            low.map("mul", array(a[(i + 1) % 3]), array(b[(i + 2) % 3])),
            low.map("mul", array(a[(i + 2) % 3]), array(b[(i + 1) % 3])),
        )
        for i in range(3)
    ]
    return np.stack(rows, axis=dim)
