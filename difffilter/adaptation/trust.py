"""Trust traps: where relative errors mislead about who is to be trusted (paper 2)."""

from __future__ import annotations

import torch
from torch import Tensor

__all__ = ["credibility_share", "trap_width", "trust_gap"]


def credibility_share(own: Tensor, others: Tensor, systems: int) -> Tensor:
    """gamma of one system with error ``own`` among N - 1 others with error ``others``.

    Inverse squares, normalised (paper 2, eq. 11): others^2 / ((N - 1) own^2 + others^2).
    Errors are of any shape that broadcasts, in the same unit.
    """
    return others.square() / ((systems - 1) * own.square() + others.square())


def trust_gap(a: Tensor, b: Tensor, systems: int) -> Tensor:
    """gamma from the true errors minus gamma from the errors relative to the prediction.

    With a the system's own error and b that of the N - 1 others (tensors that broadcast), both in
    units of the prediction's error, relative errors are a - 1 and b - 1 (paper 2, eqs. 14 and 15)::

        (N - 1)(a - b)(2ab - a - b) / ([(N - 1)a^2 + b^2] [(N - 1)(a - 1)^2 + (b - 1)^2])

    (eq. 16). Towards -1 it is a trap: a system that errs with the prediction, a near 1, is
    trusted although it is wrong.
    """
    n = systems - 1
    top = n * (a - b) * (2.0 * a * b - a - b)
    true = n * a.square() + b.square()
    relative = n * (a - 1.0).square() + (b - 1.0).square()
    return top / (true * relative)


def trap_width(b: float, systems: int, depth: float = 0.5, reach: float = 5.0) -> float:
    """Length of the interval of a, within ``reach`` of 0, where the gap is below -``depth``."""
    a = torch.linspace(-reach, reach, 200_001, dtype=torch.float64)
    gap = trust_gap(a, torch.full_like(a, b), systems)
    return float((gap < -depth).double().mean() * 2.0 * reach)
