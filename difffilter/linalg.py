"""Factors of covariances that may be singular."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["compress", "positive_sqrt", "semidefinite_cholesky"]


def positive_sqrt(x: Tensor) -> Tensor:
    """Square root of x >= 0 whose gradient at x = 0 is zero instead of infinite."""
    return x.clamp_min(torch.finfo(x.dtype).tiny).sqrt()


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
    n = covariance.shape[-1]
    remainder = covariance.movedim((-2, -1), (0, 1)).contiguous()  # rows first, batch last
    smallest = n * torch.finfo(covariance.dtype).eps * remainder.diagonal().movedim(-1, 0)
    columns = []
    for j in range(n):
        column = remainder[:, 0]
        pivot = column[0]
        regular = pivot > smallest[j]
        inverse_root = torch.where(regular, torch.where(regular, pivot, 1.0).rsqrt(), 0.0)
        column = column * inverse_root
        columns.append(torch.cat([covariance.new_zeros(j, *pivot.shape), column]))
        if j + 1 < n:
            below = column[1:]
            remainder = remainder[1:, 1:] - below.unsqueeze(1) * below
    return torch.stack(columns, dim=1).movedim((0, 1), (-2, -1))


def compress(deviations: Tensor) -> Tensor:
    """Square factor of the Gram matrix: (..., n, k) -> (..., n, n) with the same X X^T."""
    return semidefinite_cholesky(deviations @ deviations.mT)
