"""The equations of the Kalman measurement update, in Potter's square-root form.

The one place where they stand: :func:`difffilter.core.conditioning.condition` runs them,
:mod:`difffilter.core.sweep_gradient` holds their derivative.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.linalg import positive_sqrt

__all__ = ["ChannelUpdate", "Conditioned", "sweep"]


class Conditioned(NamedTuple):
    """A belief after the measurement update.

    Attributes:
        shift: (..., n), posterior mean minus prior mean.
        deviations: (..., n, k), posterior deviations.
        residual: (..., m), measurement minus posterior predicted value, per channel.
        observed: (..., m, k), posterior deviations of the predicted measurement.
    """

    shift: Tensor
    deviations: Tensor
    residual: Tensor
    observed: Tensor


class ChannelUpdate(NamedTuple):
    """One channel's update, as the gradient needs it (columns first, batch last)."""

    g: Tensor
    gain_row: Tensor
    s: Tensor
    denominator: Tensor


def sweep(
    deviations: Tensor,
    observed: Tensor,
    innovation: Tensor,
    weight: Tensor,
    noise: Tensor,
    kept: list[ChannelUpdate] | None = None,
    floor: float | None = None,
) -> tuple[Conditioned, Tensor]:
    """The equations of :func:`condition`; with ``kept``, notes what the gradient needs.

    With ``floor``, a channel whose variance has fallen to that share of what it was before
    all updates is left out: its s is taken as huge, in value and gradient.

    They run on one table with a row for each of [state; channel]: its columns of D, then
    what is left of the innovation, mu_i being 0 for a state. That last column takes part
    in the update of D with the gain w / s, the others with w / (s + sqrt(r s)). Columns
    come first and the batch last, so that every operation runs over contiguous memory.
    """
    n, k = deviations.shape[-2:]
    columns = [x.movedim((-1, -2), (0, 1)) for x in (deviations, observed)]
    left = [torch.zeros_like(columns[0][0]), innovation.movedim(-1, 0)]
    table = torch.cat([torch.cat(columns, dim=1), torch.cat(left).unsqueeze(0)])
    weight, noise = weight.movedim(-1, 0), noise.movedim(-1, 0)
    # sqrt(r) beside the columns of D, 0 beside the last one: (m, k + 1, 1, ...)
    root = positive_sqrt(noise)[:, None, None]
    root = torch.cat([root.expand(-1, k, *root.shape[2:]), torch.zeros_like(root)], dim=1)
    least = None if floor is None else _least(observed, weight, noise, floor)
    for i, (w, r, root_r) in enumerate(zip(weight, noise, root, strict=True), start=n):
        row = table[:, i : i + 1]
        f = row[:k]
        g = (table[:k] * f).sum(0)
        s = torch.addcmul(r, w, g[i])
        if least is not None:
            s = torch.where(s > least[i - n], s, torch.finfo(s.dtype).max ** 0.5)
        denominator = torch.addcmul(s, root_r, s.sqrt())
        gain_row = w / denominator * row
        table = torch.addcmul(table, g, gain_row, value=-1)
        if kept is not None:
            kept.append(ChannelUpdate(g, gain_row, s, denominator))
    rows, left_over = table[:k].movedim((0, 1), (-1, -2)), table[k].movedim(0, -1)
    conditioned = Conditioned(
        -left_over[..., :n], rows[..., :n, :], left_over[..., n:], rows[..., n:, :]
    )
    return conditioned, table


def _least(observed: Tensor, weight: Tensor, noise: Tensor, floor: float) -> Tensor:
    """(m, ...), the share ``floor`` of each channel's s before all updates."""
    before = observed.detach().square().sum(-1).movedim(-1, 0)
    return floor * (weight.detach() * before + noise.detach())
