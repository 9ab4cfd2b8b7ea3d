"""The one Kalman measurement update of this library.

Every filter is: linearise, weigh, :func:`condition`. Nothing else conditions a belief.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.linalg import needs_gradient, positive_sqrt

__all__ = ["Conditioned", "condition"]


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


def condition(
    deviations: Tensor, observed: Tensor, innovation: Tensor, weight: Tensor, noise: Tensor
) -> Conditioned:
    """Condition on independent scalar channels, one after the other (Potter's form).

    For channel i with weight w, f = row i of the observed deviations Z, D = [X; Z]::

        g  = D f                              covariance of everything with channel i
        s  = w g_i + r                        innovation variance times w
        mu = mu + (w g / s) (z_i - mu_i)
        D  = D - w / (s + sqrt(r s)) g f^T

    Exact for independent channels, positive semidefinite by construction, finite and
    differentiable at w = 0, valid for a singular X X^T; it inverts nothing. The weight
    multiplies the channel's information (R -> R / w); w = 0 deletes the channel.

    Noise common to channels is passed as further columns of ``observed`` (zero in
    ``deviations``). With ``noise`` = R_ii (1 - w) a full R may stand entirely in those
    columns.

    Args:
        deviations: (..., n, k), prior deviations X, P = X X^T.
        observed: (..., m, k), deviations Z of the predicted measurement.
        innovation: (..., m), measurement minus prediction (angles wrapped); any finite
            number where the channel is missing.
        weight: (..., m) in [0, 1]; 0 where the channel is missing.
        noise: (..., m), independent noise variance r >= 0 of each channel.

    Returns:
        Shift of the mean (..., n), posterior deviations (..., n, k), and residuals (..., m).

    Source: J. E. Potter's square-root update, applied to the stacked state and
    predicted measurement [reconstruction].
    """
    tensors = (deviations, observed, innovation, weight, noise)
    if needs_gradient(*tensors):
        from difffilter.condition_gradient import ChannelSweep

        return Conditioned(*ChannelSweep.apply(*tensors))  # type: ignore[no-untyped-call]
    return sweep(*tensors)[0]


def sweep(
    deviations: Tensor,
    observed: Tensor,
    innovation: Tensor,
    weight: Tensor,
    noise: Tensor,
    kept: list[ChannelUpdate] | None = None,
) -> tuple[Conditioned, Tensor]:
    """The equations of :func:`condition`; with ``kept``, notes what the gradient needs.

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
    for i, (w, r, root_r) in enumerate(zip(weight, noise, root, strict=True), start=n):
        row = table[:, i : i + 1]
        f = row[:k]
        g = (table[:k] * f).sum(0)
        s = torch.addcmul(r, w, g[i])
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
