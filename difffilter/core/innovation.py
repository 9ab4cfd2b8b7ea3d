"""What a nominal innovation is expected to be: its variance, its NIS, its log density."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from difffilter.core.equations import ChannelUpdate, sweep
from difffilter.core.linalg import square_norms

__all__ = ["innovation_variance", "log_densities", "log_density", "nis", "shared_log_density"]

#: Variances whose product is taken before its logarithm: it stays far from the largest number.
TOGETHER = 4


def innovation_variance(observed: Tensor, noise: Tensor) -> Tensor:
    """(..., m), diagonal of S = Z Z^T + diag r, from Z (..., m, k) and r (..., m)."""
    return square_norms(observed) + noise


def nis(observed: Tensor, noise: Tensor, innovation: Tensor, present: Tensor) -> Tensor:
    """(...), nu^T S^-1 nu over the present channels; 0 with none.

    The sum of e_i^2 / s_i, where e_i is what the channels before leave of innovation i and s_i
    its variance then: what the update itself goes through. No matrix is formed or factored,
    so that it is right however large Z Z^T is beside the noise.
    """
    return _channels(observed, noise, innovation, present)[0].sum(-1)


def log_densities(observed: Tensor, noise: Tensor, innovation: Tensor, present: Tensor) -> Tensor:
    """(..., m), log density of each channel's innovation given those before; 0 where missing."""
    squares, logarithms = _channels(observed, noise, innovation, present)
    each = -0.5 * (squares + logarithms + math.log(2.0 * math.pi))
    return torch.where(present, each, 0.0)


def shared_log_density(
    observed: Tensor, noise: Tensor, innovation: Tensor, present: Tensor
) -> Tensor:
    """(...), the same sum for noise above 0, by what the update goes through anyway.

    Beside the update of a filter without weights the compiled engine has nothing left to do but
    a logarithm for every ``TOGETHER`` channels (in float64; in float32 such products overflow).
    """
    weight = present.to(noise.dtype)
    gain, s = _gains(observed, noise, innovation, weight)
    known = torch.where(present, s, 1.0)
    together = TOGETHER if s.dtype == torch.float64 else 1
    total = (gain.square() * s).sum(-1) + weight.sum(-1) * math.log(2.0 * math.pi)
    for at in range(0, known.shape[-1], together):
        total = total + known[..., at : at + together].prod(-1).log()
    return -0.5 * total


def log_density(observed: Tensor, noise: Tensor, innovation: Tensor, present: Tensor) -> Tensor:
    """(...), log N(nu; 0, S) over the present channels, the sum of theirs; 0 with none."""
    return log_densities(observed, noise, innovation, present).sum(-1)


def _channels(
    observed: Tensor, noise: Tensor, innovation: Tensor, present: Tensor
) -> tuple[Tensor, Tensor]:
    """(..., m) each, e_i^2 / s_i and log s_i of the present channels."""
    weight = present.to(noise.dtype)
    noise = torch.where(present, noise, 1.0)
    gain, s = _gains(observed, noise, innovation, weight)
    return gain.square() * s, weight * s.log()


def _gains(
    observed: Tensor, noise: Tensor, innovation: Tensor, weight: Tensor
) -> tuple[Tensor, Tensor]:
    """(..., m) each, w_i e_i / s_i and s_i."""
    kept: list[ChannelUpdate] = []
    sweep(observed[..., :0, :], observed, innovation, weight, noise, kept)
    # The last entry of a gain row is w e / s, and w is 0 or 1.
    gain = torch.stack([update.gain_row[-1, 0] for update in kept], dim=-1)
    s = torch.stack([update.s for update in kept], dim=-1)
    return gain, s
