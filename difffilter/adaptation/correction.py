"""Correction of the prediction by what an innovation exceeds (paper 4, LCASRCKF)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.adaptation.matching import BEFORE
from difffilter.adaptation.passive import Memory, Passive, jacobian
from difffilter.core.linalg import minimum_norm, square_norms
from difffilter.core.linearised import Linearised
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants
from difffilter.weights.weight import soft_relu

__all__ = ["PredictionCorrection", "corrected", "excess"]

#: Share of the prediction in the innovation's variance from which on an excess is all its own.
SHARE = 0.35
#: The most that a velocity moves, in units of what the prior's own covariance would move it.
SLOPE = 5.0


@dataclass(frozen=True)
class PredictionCorrection(Passive):
    """The predicted position moved by the excess of the innovation, the velocity with it.

    Per channel d = sign(e) max(0, |e| - lambda sqrt(P_zz)), lambda = 2 in [2, 3) [P]; the
    position moves by the least-squares solution of H_p delta = d, the velocity of that axis by
    delta / ((m + 1) T) [R]; the covariance stays, and the ordinary update follows at the new
    mean. For a measured position delta is d.

    Where rows follow each other closely an excess is noise, or older than the last row. Two
    bounds, which do not bind where a row tells as much as what came before it [R]: d is
    multiplied by min(1, (1 - R / P_zz) / 0.35)^2, the prediction's share in P_zz, and the
    velocity moves by no more than 5 P_vp / P_pp delta, P the predicted covariance.

    m counts flagged rows just before, of :class:`InnovationMatching` in a chain before it or in
    the fusion; 0 alone. Paper 4: [P] stated there, [R] reconstruction.

    Attributes:
        axes: positions, the first states; their velocities are the next.
    """

    axes: int = 2

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """lambda, in standard deviations of the innovation."""
        meaning = "innovation beyond which the prediction is corrected"
        return (
            Parameter("correction.lambda", 2.0, Positive(), "sigma", "paper 4", meaning=meaning),
        )

    def before_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        present: Tensor,
        inputs: Memory,
        constants: Constants,
    ) -> tuple[Linearised, Memory]:
        """The step linearised at the corrected mean, with the noise that it had."""
        d = excess(linearised, present, constants)
        mean = corrected(linearised, d, present, self.axes, memory.get(BEFORE))
        return linearised.at(mean, linearised.factor), memory


def excess(linear: Linearised, present: Tensor, constants: Constants) -> Tensor:
    """d (..., m): what of each innovation exceeds lambda standard deviations; 0 where missing."""
    size = linear.innovation.abs()
    bound = constants["correction.lambda"] * linear.innovation_variance.sqrt()
    temperature = constants.get("temperature")
    if temperature is None:
        beyond = (size - bound).clamp_min(0.0)
    else:  # in units of the bound, so that a temperature means the same in m and rad
        beyond = bound * soft_relu(size / bound - 1.0, temperature)
    variance = linear.innovation_variance
    share = (1.0 - linear.independent / variance) / SHARE
    d = linear.innovation.sign() * beyond * share.clamp(0.0, 1.0).square()
    return torch.where(present, d, 0.0)


def corrected(
    linear: Linearised, d: Tensor, present: Tensor, axes: int, streak: Tensor | None = None
) -> Tensor:
    """(..., n), the mean with position and velocity moved by the excess d."""
    n, mean = linear.mean.shape[-1], linear.mean
    unit = torch.eye(n, dtype=mean.dtype, device=mean.device)[:, :axes]
    h = jacobian(linear, unit.expand(*mean.shape, axes)) * present.unsqueeze(-1)
    delta = minimum_norm(h, d)
    time = linear.dt if streak is None else linear.dt * (streak + 1.0)
    shift = torch.cat([delta, delta * _rate(linear, time.unsqueeze(-1), axes)], dim=-1)
    return mean + torch.nn.functional.pad(shift, (0, n - 2 * axes))


def _rate(linear: Linearised, time: Tensor, axes: int) -> Tensor:
    """(..., axes), velocity per corrected position: 1 / time, at most SLOPE P_vp / P_pp."""
    columns = linear.deviations[..., : linear.own]
    position, velocity = columns[..., :axes, :], columns[..., axes : 2 * axes, :]
    variance, covariance = square_norms(position), (position * velocity).sum(-1)
    known = variance > 0.0
    slope = torch.where(known, covariance.clamp_min(0.0) / torch.where(known, variance, 1.0), 0.0)
    most = SLOPE * slope
    # 1 / max(time, 1 / most), without a division by 0
    return most / torch.maximum(time * most, torch.ones_like(most))
