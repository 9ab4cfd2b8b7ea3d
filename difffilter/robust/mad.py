"""The scale of residuals by their median absolute deviation."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["mad_scale"]


def mad_scale(residuals: Tensor) -> Tensor:
    """1.48 times the median absolute deviation over the last axis, NaN left out."""
    spread = _median((residuals - _median(residuals)).abs())
    spread = torch.where(torch.isnan(spread), 1.0, spread)  # no row at all
    # With most residuals equal the deviation is 0: keep the scale away from it.
    return (1.48 * spread).clamp_min(1e-3)


def _median(x: Tensor) -> Tensor:
    """Median over the last axis, NaN left out: the mean of the middle two of an even number."""
    low = x.nanmedian(dim=-1, keepdim=True).values
    high = -(-x).nanmedian(dim=-1, keepdim=True).values
    return 0.5 * (low + high)
