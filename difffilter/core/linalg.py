"""Factors of covariances that may be singular, and products of small matrices.

Everything runs with the matrix indices first and the batch last in memory: operations on
many small matrices are then contiguous loops over the batch, several times faster.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = [
    "components",
    "join",
    "minimum_norm",
    "needs_gradient",
    "positive_sqrt",
    "product",
    "semidefinite_cholesky",
    "square_norms",
]


def positive_sqrt(x: Tensor) -> Tensor:
    """Square root of x >= 0 whose gradient at x = 0 is zero instead of infinite."""
    return x.clamp_min(torch.finfo(x.dtype).tiny).sqrt()


def needs_gradient(*tensors: Tensor) -> bool:
    """Whether a written backward may stand in for autograd: not under torch.func transforms."""
    if not torch.is_grad_enabled() or torch._C._are_functorch_transforms_active():
        return False
    return any(x.requires_grad for x in tensors)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Matrix product (..., i, j) (..., j, k) -> (..., i, k) of small matrices in large batches.

    Leading dimensions broadcast; further rows of b are left out.
    """
    if a.dim() != b.dim():
        rank = max(a.dim(), b.dim())
        a, b = (x[(None,) * (rank - x.dim())] for x in (a, b))
    inner = a.shape[-1]
    a, b = a.movedim((-2, -1), (0, 1)), b.movedim((-2, -1), (0, 1))
    b = b if b.shape[0] == inner else b[:inner]
    return (a.unsqueeze(2) * b).sum(1).movedim((0, 1), (-2, -1))


def square_norms(rows: Tensor) -> Tensor:
    """Sum of squares of each row, (..., m, k) -> (..., m)."""
    return rows.movedim((-2, -1), (0, 1)).square().sum(1).movedim(0, -1)


def components(vectors: Tensor, count: int) -> Tensor:
    """The first components of vectors, (..., n) -> (..., count)."""
    return vectors.movedim(-1, 0)[:count].movedim(0, -1)


def join(parts: Sequence[Tensor], dim: int, core: int = 2) -> Tensor:
    """``torch.cat`` along one of the last ``core`` dimensions (dim = -1 or -2)."""
    first, last = tuple(range(core)), tuple(range(-core, 0))
    return torch.cat([x.movedim(last, first) for x in parts], dim=core + dim).movedim(first, last)


def semidefinite_cholesky(covariance: Tensor) -> Tensor:
    """Lower-triangular L with L L^T = P for a positive semidefinite P.

    Column j is zero where the pivot is zero (relative to the machine precision of the
    diagonal): the value and the gradient of such a column are both guarded, so that
    P0 = diag(1e6, 0, 1e6, 0) and rank-deficient process noise pass.

    Args:
        covariance: (..., n, n), symmetric positive semidefinite.

    Returns:
        (..., n, n), lower triangular with a non-negative diagonal.
    """
    return factor(covariance.movedim((-2, -1), (0, 1)).contiguous())[0].movedim((0, 1), (-1, -2))


def minimum_norm(h: Tensor, d: Tensor) -> Tensor:
    """Least-squares solution x (..., j) of H x = d of least norm, whatever the rank of H.

    With H^T H = L L^T, C the columns of L with a pivot: x = C (C^T C)^-2 C^T H^T d. A pivot
    within 100 units of rounding of the largest diagonal entry counts as zero, so that C^T C is
    never singular.

    Args:
        h: (..., m, j); d: (..., m).
    """
    normal = h.mT @ h
    columns, _ = factor(normal.movedim((-2, -1), (0, 1)).contiguous(), 100.0, largest=True)
    lower = columns.movedim((0, 1), (-1, -2))
    inner = lower.mT @ lower
    missing = (inner.diagonal(dim1=-2, dim2=-1) == 0.0).to(inner.dtype)
    inner = inner + torch.diag_embed(missing)
    right = lower.mT @ (h.mT @ d.unsqueeze(-1))
    solved: Tensor = torch.linalg.solve(inner, torch.linalg.solve(inner, right))
    return (lower @ solved).squeeze(-1)


def factor(
    remainder: Tensor, units: float | None = None, largest: bool = False
) -> tuple[Tensor, list[Tensor]]:
    """Of (n, n, ...): the columns of L, (column, row, ...), and the inverse root of each pivot.

    A pivot is zero within ``units`` (n if None) of rounding of its diagonal entry, or of the
    ``largest`` one.
    """
    n = remainder.shape[0]
    units = float(n) if units is None else units
    scale = remainder.diagonal().movedim(-1, 0)
    scale = scale.amax(0, keepdim=True).expand_as(scale) if largest else scale
    smallest = units * torch.finfo(remainder.dtype).eps * scale
    zeros, infinity = torch.zeros_like(remainder[0]), remainder.new_tensor(torch.inf)
    parts, inverse_roots = [], []
    for j, least in enumerate(smallest):
        column = remainder[0]
        # A zero pivot: 1 / sqrt(infinity), whose derivative is zero too.
        pivot = column[0]
        inverse_root = torch.where(pivot > least, pivot, infinity).rsqrt()
        column = column * inverse_root
        parts += [zeros[:j], column]
        inverse_roots.append(inverse_root)
        if j + 1 < n:
            below = column[1:]
            remainder = torch.addcmul(remainder[1:, 1:], below.unsqueeze(1), below, value=-1)
    return torch.cat(parts).reshape(n, n, *zeros.shape[1:]), inverse_roots


def gram(blocks: Sequence[Tensor]) -> Tensor:
    """Sum of X_i X_i^T, (..., n, n)."""
    first, *more = (product(x, x.mT) for x in blocks)
    return sum(more, first)
