"""Two estimates of one state merged: the information of both."""

from __future__ import annotations

import torch
from torch import Tensor

from difffilter.core.compression import compress
from difffilter.core.conditioning import condition

__all__ = ["merged_estimate"]


def merged_estimate(
    mean: Tensor, deviations: Tensor, other_mean: Tensor, other: Tensor, floor: float = 0.0
) -> tuple[Tensor, Tensor]:
    """Mean and deviations of P^-1 = P_1^-1 + P_2^-1, x = P (P_1^-1 x_1 + P_2^-1 x_2).

    The measurement update again: the second estimate is a measurement of the state whose full
    covariance stands in the common columns. Nothing is inverted.

    Args:
        mean, other_mean: (..., n); deviations, other: (..., n, n).
        floor: as for :func:`difffilter.core.conditioning.condition`, for singular covariances.
    """
    done = condition(
        torch.cat([deviations, torch.zeros_like(other)], dim=-1),
        torch.cat([deviations, other], dim=-1),
        other_mean - mean,
        torch.ones_like(mean),
        torch.zeros_like(mean),
        floor=floor,
    )
    return mean + done.shift, compress(done.deviations)
