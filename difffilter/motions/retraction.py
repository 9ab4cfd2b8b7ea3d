"""Beliefs of a state that is not a vector: points, gradients and shifts in the tangent space.

For a flat state everything here is plus and minus, at no cost.
"""

from __future__ import annotations

import torch
from torch import Tensor

from difffilter.core.cubature import points
from difffilter.core.jacobian import jacobian_times
from difffilter.motions.protocol import Motion

__all__ = ["cloud", "lifted", "moved"]


def lifted(motion: Motion, mean: Tensor, deviations: Tensor) -> Tensor:
    """Deviations (..., p, k) as changes of the mean's numbers (..., n, k), to first order."""
    if motion.flat:
        return deviations
    zero = torch.zeros_like(deviations[..., 0])
    return jacobian_times(lambda shift: motion.retract(mean, shift), zero, deviations)


def cloud(motion: Motion, mean: Tensor, deviations: Tensor) -> Tensor:
    """Cubature points (2p, ..., n) about a mean, from deviations (..., p, p)."""
    if motion.flat:
        return points(mean, deviations)
    zero = torch.zeros_like(deviations[..., 0])
    return motion.retract(mean.expand(2 * zero.shape[-1], *mean.shape), points(zero, deviations))


def moved(motion: Motion, mean: Tensor, shift: Tensor, deviations: Tensor) -> tuple[Tensor, Tensor]:
    """The mean moved by a shift (..., p), and the deviations (..., p, k) carried there.

    They are multiplied by the derivative of local(retract(m, s), retract(m, s + d)) at d = 0.
    """
    after = motion.retract(mean, shift)
    if motion.flat:
        return after, deviations

    def local(more: Tensor) -> Tensor:
        return motion.local(after, motion.retract(mean, shift + more))

    return after, jacobian_times(local, torch.zeros_like(shift), deviations)
