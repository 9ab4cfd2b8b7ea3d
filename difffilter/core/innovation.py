"""What a nominal innovation is expected to be: its variance."""

from __future__ import annotations

from torch import Tensor

from difffilter.core.linalg import square_norms

__all__ = ["innovation_variance"]


def innovation_variance(observed: Tensor, noise: Tensor) -> Tensor:
    """(..., m), diagonal of S = Z Z^T + diag r, from Z (..., m, k) and r (..., m)."""
    return square_norms(observed) + noise
