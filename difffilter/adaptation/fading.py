"""Fading: the predicted covariance raised until it explains the innovations (paper 4)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from difffilter.adaptation.passive import Memory, Passive, jacobian
from difffilter.core.compression import compress
from difffilter.core.linalg import square_norms
from difffilter.core.linearised import Linearised
from difffilter.parameters.constraints import Interval, Positive
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants
from difffilter.weights.registry import plain
from difffilter.weights.weight import Weight

__all__ = ["MultipleFading", "StrongTracking"]

AVERAGE, STARTED = "fading.average", "fading.started"


@dataclass(frozen=True)
class StrongTracking(Passive):
    """One fading factor for all states (Zhou and Frank), paper 4's STF-SRCKF [L].

    With V_1 = e e^T, V_k = (rho V + e e^T)/(1 + rho), H the (statistical) Jacobian::

        N = V - H Q H^T - beta R      M = P_zz - R - H Q H^T
        lambda = max(1, tr N / tr M)  P <- lambda (P - Q) + Q

    over the present channels; then the measurement is linearised with the new P. R is divided
    by ``weight`` of e / sqrt(R) where one is given. Parameters ``fading.beta`` (4.5) and
    ``fading.rho`` (0.95).

    Attributes:
        weight: of the measurement noise, ``plain`` for none.

    Memory: ``fading.average`` (..., m), diagonal of V; ``fading.started`` (...).
    """

    weight: Weight = plain

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Weakening and forgetting factors, and those of the weight."""
        beta = "softens: how much of R counts against fading"
        return (
            Parameter("fading.beta", 4.5, Positive(), "1", "paper 4, Zhou and Frank", meaning=beta),
            Parameter(
                "fading.rho",
                0.95,
                Interval(),
                "1",
                "Zhou and Frank",
                meaning="forgetting factor of the averaged innovations",
            ),
            *self.weight.parameters,
        )

    def memory(self, mean: Tensor, channels: int) -> dict[str, Tensor]:
        """No innovation yet."""
        lead = mean.shape[:-1]
        return {AVERAGE: mean.new_zeros(*lead, channels), STARTED: mean.new_zeros(lead)}

    def before_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        present: Tensor,
        inputs: Memory,
        constants: Constants,
    ) -> tuple[Linearised, Memory]:
        """The step linearised with the faded covariance."""
        e, rho = linearised.innovation, constants["fading.rho"]
        started = memory[STARTED].unsqueeze(-1)
        average = (rho * started * memory[AVERAGE] + e.square()) / (1.0 + rho * started)
        average = torch.where(present, average, memory[AVERAGE])
        noise = linearised.independent
        w = self.weight(e * noise.rsqrt(), constants, constants.get("temperature"))
        hqh = square_norms(jacobian(linearised, linearised.process))
        above = average - hqh - constants["fading.beta"] * noise / w.clamp_min(1e-12)
        below = linearised.innovation_variance - noise - hqh
        above, below = (torch.where(present, x, 0.0) for x in (above, below))
        root = self.factors(linearised, above, below).sqrt()
        deviations = compress(root.unsqueeze(-1) * linearised.moved, linearised.process)
        faded = linearised.at(linearised.mean, deviations)
        measured = present.any(-1)
        new = {AVERAGE: average, STARTED: torch.where(measured, 1.0, memory[STARTED])}
        return faded, {**memory, **new}

    def factors(self, linearised: Linearised, above: Tensor, below: Tensor) -> Tensor:
        """(..., n), what each state's moved covariance is multiplied by."""
        factor = _ratio(above.sum(-1), below.sum(-1))
        return factor.unsqueeze(-1).expand_as(linearised.mean)


@dataclass(frozen=True)
class MultipleFading(StrongTracking):
    """A fading factor per state, paper 4's RMCKF [P idea, R combination].

    Per channel c = max(1, N_ll / M_ll); per state lambda_j = max(1, sum_l a_lj c_l) with
    a = |H F|, its columns normalised; P <- L (P - Q) L + Q, L = diag sqrt(lambda). N with R / w,
    w the weight (Huber) of the innovation, which the filter's own weight then applies.
    """

    #: No larger process noise makes this covariance of the same past: nothing to smooth by.
    rescales: ClassVar[bool] = True

    def factors(self, linearised: Linearised, above: Tensor, below: Tensor) -> Tensor:
        n = linearised.mean.shape[-1]
        channel = _ratio(above, below)
        unit = torch.eye(n, dtype=channel.dtype, device=channel.device)
        f = linearised.transition(unit.expand(*linearised.mean.shape, n))
        share = jacobian(linearised, f).abs()
        total = share.sum(-2, keepdim=True)
        share = share / torch.where(total > 0.0, total, 1.0)
        return (share * channel.unsqueeze(-1)).sum(-2).clamp_min(1.0)


def _ratio(above: Tensor, below: Tensor) -> Tensor:
    """max(1, above / below); 1 where the prediction adds nothing."""
    usable = below > 0.0
    return torch.where(usable, above / torch.where(usable, below, 1.0), 1.0).clamp_min(1.0)
