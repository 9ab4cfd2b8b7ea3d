"""Factors of covariances that may be singular, and products of small matrices.

Everything runs with the matrix indices first and the batch last in memory: operations on
many small matrices are then contiguous loops over the batch, several times faster.
"""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["compress", "needs_gradient", "positive_sqrt", "product", "semidefinite_cholesky"]


def positive_sqrt(x: Tensor) -> Tensor:
    """Square root of x >= 0 whose gradient at x = 0 is zero instead of infinite."""
    return x.clamp_min(torch.finfo(x.dtype).tiny).sqrt()


def needs_gradient(*tensors: Tensor) -> bool:
    """Whether a written backward may stand in for autograd: not under torch.func transforms."""
    if not torch.is_grad_enabled() or torch._C._are_functorch_transforms_active():
        return False
    return any(x.requires_grad for x in tensors)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Matrix product (..., i, j) (..., j, k) -> (..., i, k) of small matrices in large batches."""
    a, b = a.movedim((-2, -1), (0, 1)), b.movedim((-2, -1), (0, 1))
    return (a.unsqueeze(2) * b).sum(1).movedim((0, 1), (-2, -1))


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


def factor(remainder: Tensor) -> tuple[Tensor, list[Tensor]]:
    """Of (n, n, ...): the columns of L, (column, row, ...), and the inverse root of each pivot."""
    n = remainder.shape[0]
    smallest = n * torch.finfo(remainder.dtype).eps * remainder.diagonal().movedim(-1, 0)
    zeros = torch.zeros_like(remainder[0])
    parts, inverse_roots = [], []
    for j in range(n):
        column = remainder[0]
        pivot = column[0]
        regular = pivot > smallest[j]
        inverse_root = torch.where(regular, torch.where(regular, pivot, 1.0).rsqrt(), 0.0)
        column = column * inverse_root
        parts += [zeros[:j], column]
        inverse_roots.append(inverse_root)
        if j + 1 < n:
            below = column[1:]
            remainder = remainder[1:, 1:] - below.unsqueeze(1) * below
    return torch.cat(parts).unflatten(0, (n, n)), inverse_roots


def compress(deviations: Tensor) -> Tensor:
    """Square factor of the Gram matrix: (..., n, k) -> (..., n, n) with the same X X^T."""
    if needs_gradient(deviations):
        from difffilter.compress_gradient import Compress

        lower: Tensor = Compress.apply(deviations)  # type: ignore[no-untyped-call]
        return lower
    return semidefinite_cholesky(product(deviations, deviations.mT))
