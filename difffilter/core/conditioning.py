"""The one Kalman measurement update of this library.

Every filter is: linearise, weigh, :func:`condition`. Nothing else conditions a belief.
"""

from __future__ import annotations

from torch import Tensor

from difffilter.core.equations import Conditioned, sweep
from difffilter.core.linalg import needs_gradient
from difffilter.core.sweep_gradient import ChannelSweep

__all__ = ["condition"]


def condition(
    deviations: Tensor,
    observed: Tensor,
    innovation: Tensor,
    weight: Tensor,
    noise: Tensor,
    *,
    floor: float | None = None,
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
        floor: for channels without noise: one whose variance falls to this share of what it
            was has told all that it can, and its gain is 0; None where s > 0 is known.

    Returns:
        Shift of the mean (..., n), posterior deviations (..., n, k), and residuals (..., m).

    Source: J. E. Potter's square-root update, applied to the stacked state and
    predicted measurement [reconstruction].
    """
    tensors = (deviations, observed, innovation, weight, noise)
    if needs_gradient(*tensors):
        return Conditioned(*ChannelSweep.apply(*tensors, floor))  # type: ignore[no-untyped-call]
    return sweep(*tensors, floor=floor)[0]
