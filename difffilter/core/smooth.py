"""One step back in time: conditioning on the next state, without noise.

With the filtered deviations X at k, the moved ones F X and the process columns L, the pair of
x_k and x_{k+1} has the deviations D = [X 0; F X L]. Conditioning on its lower half without
noise, by the one measurement update of this library, gives the gain G and what is left of
x_k, and these give any smoothed estimate from the next one's (H. E. Rauch, F. Tung and
C. T. Striebel, 1965, here in square-root form [reconstruction])::

    m_s = m + G (m_s' - f(m)),    X_s = compress([X - G F X, -G L, G X_s'])
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.compression import compress
from difffilter.core.conditioning import condition

__all__ = ["Backward", "backward", "disturbance"]


class Backward(NamedTuple):
    """What leads from the next state back to this one.

    Attributes:
        gain: (..., n, n), G; 0 in directions in which the next state has no variance.
        left: (..., n, k), deviations of this state where the next one is known.
    """

    gain: Tensor
    left: Tensor

    def mean(self, mean: Tensor, change: Tensor) -> Tensor:
        """(..., n) from the filtered mean and the next mean's departure from the prediction."""
        return mean + (self.gain @ change.unsqueeze(-1)).squeeze(-1)

    def deviations(self, later: Tensor) -> Tensor:
        """(..., n, n) from those of the next state."""
        return compress(self.left, self.gain @ later)


def backward(filtered: Tensor, moved: Tensor, process: Tensor) -> Backward:
    """Gain and remaining deviations from one row to the row before.

    The n columns of the gain are the shifts of n unit innovations, all at once. A direction
    of the next state that has no variance (left, to the precision of the factors) has gain 0:
    nothing is inverted, and any of the three may be singular.

    Args:
        filtered: (..., n, j), X at k.
        moved: (..., n, j), F X, column by column of X.
        process: (..., n, q), L with Q = L L^T.
    """
    return _told(torch.nn.functional.pad(filtered, (0, process.shape[-1])), moved, process)


def disturbance(moved: Tensor, process: Tensor) -> Backward:
    """What the next state tells of the process noise w ~ N(0, I_q) that led to it, L w.

    The same conditioning with [0 I] in place of [X 0]: ``gain`` (..., q, n), ``left``
    (..., q, k); mean and deviations of w from the next row's smoothed ones, as of a state
    whose filtered mean is 0.

    Args:
        moved: (..., n, j), F X; process: (..., n, q), L with Q = L L^T.
    """
    q = process.shape[-1]
    unit = torch.eye(q, dtype=process.dtype, device=process.device)
    upper = torch.nn.functional.pad(unit, (moved.shape[-1], 0))
    return _told(upper.expand(*process.shape[:-2], *upper.shape), moved, process)


def _told(upper: Tensor, moved: Tensor, process: Tensor) -> Backward:
    """The deviations ``upper`` (..., p, j + q) conditioned on the next state, without noise."""
    n = moved.shape[-2]
    lead = torch.broadcast_shapes(moved.shape[:-2], process.shape[:-2], upper.shape[:-2])  # type: ignore[no-untyped-call]
    lower = torch.cat([x.expand(*lead, *x.shape[-2:]) for x in (moved, process)], dim=-1)
    ones = lower.new_ones(*lead, n)
    unit = torch.eye(n, dtype=lower.dtype, device=lower.device)
    units = unit.reshape(n, *[1] * len(lead), n).expand(n, *lead, n)
    done = condition(
        upper.expand(n, *lead, *upper.shape[-2:]),
        lower.expand(n, *lead, *lower.shape[-2:]),
        units,
        ones.expand_as(units),
        torch.zeros_like(units),
        floor=n * torch.finfo(lower.dtype).eps,
    )
    return Backward(done.shift.movedim(0, -1), done.deviations[0])
