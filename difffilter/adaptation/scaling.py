"""Noise scales from the innovations of a sliding window (paper 3, reference [9])."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.adaptation.passive import Memory, Passive, jacobian
from difffilter.core.equations import Conditioned
from difffilter.core.linalg import positive_sqrt
from difffilter.core.linearised import Linearised
from difffilter.errors import InputError
from difffilter.parameters.constraints import OrderedPair
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants
from difffilter.sensors.information import Information

__all__ = ["InnovationScaling"]

BOUNDS_R, BOUNDS_Q = "adaptive.bounds_r", "adaptive.bounds_q"


@dataclass(frozen=True)
class InnovationScaling(Passive):
    """The filter's Q_0 and R_0 times a and b, re-estimated at each step with a measurement.

    With innovation nu, residual eps = nu - H K nu, |v|^2 = v^T R_0^-1 v / m and
    tr(A) = trace(R_0^-1 A) / m over the m channels present, three numbers enter a ring of
    ``window`` entries::

        rho  = |eps|^2 + tr(H P H^T)    P after the update;  E[eps eps^T] = R - H P H^T
        iota = |nu|^2                                        E[nu nu^T] = H P^- H^T + R
        pi   = tr(H P^- H^T)

    Once the ring is full (until then a = b = 1), with means over it::

        b = clip(mean rho, bounds_r)
        a = clip(a sqrt(max(mean iota - mean rho, 0) / mean pi), bounds_q)

    the residual-based R (Mohamed and Schwarz 1999) and the innovation-based scaling of Q
    (Ding, Wang, Rizos and Kinlyside 2007) [reconstruction of reference [9]]. A row without
    measurements leaves ring, a and b as they are.

    Attributes:
        window: entries of the ring; static.
        bounds_r, bounds_q: parameters ``adaptive.bounds_r`` and ``adaptive.bounds_q``.

    Memory: ``adaptive.ring`` (..., window, 3), ``adaptive.count``, ``adaptive.a`` and
    ``adaptive.b`` (...).
    """

    window: int = 20
    bounds_r: tuple[float, float] = (0.1, 1000.0)
    bounds_q: tuple[float, float] = (0.1, 10.0)

    def __post_init__(self) -> None:
        if self.window < 1:
            raise InputError(f"adaptive window: found {self.window}, expected 1 or more")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Bounds of the two scales."""
        return tuple(
            Parameter(
                name,
                bounds,
                OrderedPair(),
                labels=("low", "high"),
                meaning=f"bounds of the scale of {what}",
            )
            for name, bounds, what in (
                (BOUNDS_R, self.bounds_r, "the measurement noise's variance"),
                (BOUNDS_Q, self.bounds_q, "the process noise's variance"),
            )
        )

    def memory(self, mean: Tensor, channels: int) -> dict[str, Tensor]:
        """Empty ring, scales 1."""
        lead = mean.shape[:-1]
        return {
            "adaptive.ring": mean.new_zeros(*lead, self.window, 3),
            "adaptive.count": mean.new_zeros(lead),
            "adaptive.a": mean.new_ones(lead),
            "adaptive.b": mean.new_ones(lead),
        }

    def before_predict(
        self, memory: Memory, process: Tensor, inputs: Memory, constants: Constants
    ) -> Tensor:
        """Deviations of the process noise (..., n, q) times sqrt(a)."""
        return process * memory["adaptive.a"].sqrt()[..., None, None]

    def before_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        present: Tensor,
        inputs: Memory,
        constants: Constants,
    ) -> tuple[Linearised, Memory]:
        """R times b, in the independent variances and in the common columns."""
        b = memory["adaptive.b"].unsqueeze(-1)
        own = linearised.own
        state, common = linearised.observed[..., :own], linearised.observed[..., own:]
        scaled = linearised._replace(
            observed=torch.cat([state, common * b.sqrt().unsqueeze(-1)], dim=-1),
            independent=linearised.independent * b,
            total=linearised.total * b,
        )
        return scaled, memory

    def after_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        conditioned: Conditioned,
        weight: Tensor,
        present: Tensor,
        constants: Constants,
    ) -> Memory:
        """Ring and scales after the step."""
        a, b = memory["adaptive.a"], memory["adaptive.b"]
        own = linearised.own
        state, common = linearised.observed[..., :own], linearised.observed[..., own:]
        residual, after = conditioned.residual, conditioned.observed
        if common.shape[-1]:
            # The predicted measurement's own rows hold the common noise too: H times the state's.
            shift = conditioned.shift.unsqueeze(-1)
            both = jacobian(linearised, torch.cat([shift, conditioned.deviations], dim=-1))
            residual, after = linearised.innovation - both[..., 0], both[..., 1:]
        # b R_0 stands in the linearised step; R_0^-1 = b (b R_0)^-1.
        scaled = Information(linearised.independent, common, present)
        channels = present.sum(-1)
        unit = b / channels.clamp_min(1)

        def trace(deviations: Tensor) -> Tensor:
            return unit * (deviations * scaled.times(deviations)).sum((-2, -1))

        entry = torch.stack(
            [
                unit * scaled.square(residual) + trace(after),
                unit * scaled.square(linearised.innovation),
                trace(state),
            ],
            dim=-1,
        )
        measured = channels > 0
        ring = memory["adaptive.ring"].expand(*entry.shape[:-1], self.window, 3)
        moved = torch.cat([ring[..., 1:, :], entry.unsqueeze(-2)], dim=-2)
        ring = torch.where(measured[..., None, None], moved, ring)
        count = (memory["adaptive.count"] + measured).clamp_max(self.window)
        rho, iota, pi = ring.mean(-2).unbind(-1)
        ready = measured & (count >= self.window)
        growth = positive_sqrt(
            (iota - rho).clamp_min(0.0) / pi.clamp_min(torch.finfo(pi.dtype).eps)
        )
        new_a = torch.clamp(a * growth, *constants[BOUNDS_Q].unbind(-1))
        new_b = torch.clamp(rho, *constants[BOUNDS_R].unbind(-1))
        return {
            "adaptive.ring": ring,
            "adaptive.count": count,
            "adaptive.a": torch.where(ready, new_a, a),
            "adaptive.b": torch.where(ready, new_b, b),
        }
