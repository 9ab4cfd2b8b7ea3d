"""The one Kalman measurement update of this library.

Every filter is: linearise, weigh, :func:`condition`. Nothing else conditions a belief.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.linalg import positive_sqrt

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
    """One channel's update, as the gradient needs it (rows first, batch last)."""

    joint: Tensor
    mean: Tensor
    f: Tensor
    g: Tensor
    s: Tensor
    root: Tensor


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

    Source: J. E. Potter's square-root update, applied to the stacked state and
    predicted measurement [reconstruction].
    """
    n = deviations.shape[-2]
    # Rows first, batch last: every operation runs over contiguous trajectories.
    joint = torch.cat([deviations, observed], dim=-2).movedim((-2, -1), (0, 1)).contiguous()
    # The means ride along: no shift yet for the state, minus the residual for a channel.
    mean = torch.cat([torch.zeros_like(deviations[..., 0]), -innovation], dim=-1)
    mean, weight, noise = (x.movedim(-1, 0).contiguous() for x in (mean, weight, noise))
    tensors = (joint, mean, weight, noise)
    # Under torch.func transforms the plain equations run: ChannelSweep has no rule for them.
    transformed = torch._C._are_functorch_transforms_active()
    if not transformed and torch.is_grad_enabled() and any(x.requires_grad for x in tensors):
        from difffilter.condition_gradient import ChannelSweep

        joint, mean = ChannelSweep.apply(*tensors)  # type: ignore[no-untyped-call]
    else:
        joint, mean, _ = sweep(*tensors)
    posterior = joint.movedim((0, 1), (-2, -1))
    return Conditioned(
        mean[:n].movedim(0, -1),
        posterior[..., :n, :],
        -mean[n:].movedim(0, -1),
        posterior[..., n:, :],
    )


def sweep(
    joint: Tensor, mean: Tensor, weight: Tensor, noise: Tensor
) -> tuple[Tensor, Tensor, list[ChannelUpdate]]:
    """The equations of :func:`condition` on (rows, k, ...), (rows, ...), (m, ...), (m, ...)."""
    updates = []
    first = joint.shape[0] - weight.shape[0]
    for i, (w, r) in enumerate(zip(weight, noise, strict=True)):
        f = joint[first + i]
        g = (joint * f).sum(1)
        s = torch.addcmul(r, w, g[first + i])
        root = positive_sqrt(r * s)
        updates.append(ChannelUpdate(joint, mean, f, g, s, root))
        mean = torch.addcmul(mean, g, w / s * mean[first + i], value=-1)
        joint = torch.addcmul(joint, g.unsqueeze(1), w / (s + root) * f, value=-1)
    return joint, mean, updates
