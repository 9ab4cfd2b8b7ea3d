"""Correction of the prediction by what an innovation exceeds (paper 4, LCASRCKF)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.adaptation.matching import BEFORE
from difffilter.adaptation.passive import Memory, Passive, jacobian
from difffilter.core.linalg import minimum_norm
from difffilter.core.linearised import Linearised
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants
from difffilter.weights.weight import soft_relu

__all__ = ["PredictionCorrection", "corrected", "excess"]


@dataclass(frozen=True)
class PredictionCorrection(Passive):
    """The predicted position moved by the excess of the innovation, the velocity with it.

    Per channel d = sign(e) max(0, |e| - lambda sqrt(P_zz)), lambda = 2 in [2, 3) [P]; the
    position moves by the least-squares solution of H_p delta = d, the velocity of that axis by
    delta / ((m + 1) T) [R]; the covariance stays, and the ordinary update follows at the new
    mean. For a measured position delta is d. m counts flagged rows just before, of
    :class:`InnovationMatching` in a chain before it or in the fusion; 0 alone. Paper 4: [P]
    stated there, [R] reconstruction.

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
        n = mean.shape[-1]
        deviations = linearised.deviations[..., : linearised.own]
        if linearised.own > n:
            deviations = deviations[..., :n] * 2.0**0.5
        moved = linearised.again(mean, deviations)
        moved = moved._replace(independent=linearised.independent, total=linearised.total)
        return moved, memory


def excess(linear: Linearised, present: Tensor, constants: Constants) -> Tensor:
    """d (..., m): what of each innovation exceeds lambda standard deviations; 0 where missing."""
    size = linear.innovation.abs()
    bound = constants["correction.lambda"] * linear.innovation_variance.sqrt()
    temperature = constants.get("temperature")
    if temperature is None:
        beyond = (size - bound).clamp_min(0.0)
    else:  # in units of the bound, so that a temperature means the same in m and rad
        beyond = bound * soft_relu(size / bound - 1.0, temperature)
    return torch.where(present, linear.innovation.sign() * beyond, 0.0)


def corrected(
    linear: Linearised, d: Tensor, present: Tensor, axes: int, streak: Tensor | None = None
) -> Tensor:
    """(..., n), the mean with position and velocity moved by the excess d."""
    n, mean = linear.mean.shape[-1], linear.mean
    unit = torch.eye(n, dtype=mean.dtype, device=mean.device)[:, :axes]
    h = jacobian(linear, unit.expand(*mean.shape, axes)) * present.unsqueeze(-1)
    delta = minimum_norm(h, d)
    time = linear.dt if streak is None else linear.dt * (streak + 1.0)
    # Without any time passed the velocity has not brought the target there.
    rate = torch.where(time > 0.0, 1.0 / torch.where(time > 0.0, time, 1.0), 0.0)
    shift = torch.cat([delta, delta * rate.unsqueeze(-1)], dim=-1)
    return mean + torch.nn.functional.pad(shift, (0, n - 2 * axes))
