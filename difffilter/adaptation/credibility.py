"""Credibility of systems, and of the prediction: who disagrees with it, and how (paper 2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from difffilter.adaptation.passive import Memory, Passive
from difffilter.core.equations import Conditioned
from difffilter.core.linalg import positive_sqrt, square_norms
from difffilter.core.linearised import Linearised
from difffilter.errors import InputError
from difffilter.parameters.constraints import Bounded, Interval, Positive
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants

__all__ = ["Credibility"]

RATIO, VARIANCE, DRIFT = "credibility.ratio", "credibility.variance", "credibility.drift"
#: Relative floor of an averaged variance: with errors of exactly 0 the shares stay finite.
LEAST = 1e-12


@dataclass(frozen=True)
class Credibility(Passive):
    """Shares out the measurement information by how well systems agree with the prediction.

    Relative errors w' = y - C x(k|k-1) against the global prediction; their variance R' by
    exponential averaging at ``rate``, started at R, of each channel and averaged over a
    system's channels. With the present systems' information t_i = sum of g / r over their
    channels, g the channel's predicted variance::

        gamma_i ~ a_i (R'_i + floor)^-p     sum gamma_i = 1 (paper 2, eq. 10: p 1, floor 0)
        system i counts gamma_i I,  I = (1 - f) sum t_j + f sum t_j R_j / R'_j

    (f ``followed``: 0 conserves the total information) and a_i the sum of g, which is the same
    for all systems that measure the same thing. That gamma shares out the measurement
    information is a reading of the paper: as it stands, gamma only sets the shares of a
    federated filter, on which its fused estimate does not depend.

    Credibility of the prediction [extension]: a bad system disagrees with the prediction
    alone; in a manoeuvre all do, to the same side. With u the shift of each position by the
    update, over the standard deviation that it has from the gammas and R'::

        D    = exponential average of u at rate b ``drift_rate``, over sqrt(b / (2 - b))
        q^2 -> q^2 (1 + kappa max(0, mean D^2 - 1))      published: kappa 0

    Attributes:
        systems: indices of the channels of each system.
        axes: positions, the first states.
        ideal: not to deploy: R and gamma from the log's inputs ``ideal.variance`` and
            ``ideal.error`` (..., m), and the process noise's level ``ideal.process`` (...)
            where it is not NaN.

    Raises:
        InputError: fewer than two systems.

    Memory: ``credibility.ratio`` (..., m), R' / R; ``credibility.variance`` (..., m), R' as of
    the last row; ``credibility.drift`` (..., axes).
    """

    #: Noise common to channels, or a full R, is refused.
    independent_noise: ClassVar[bool] = True

    systems: tuple[tuple[int, ...], ...]
    axes: int
    ideal: bool = False

    def __post_init__(self) -> None:
        if len(self.systems) < 2:
            raise InputError(f"credibility: found {len(self.systems)} system, expected two or more")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The mapping's, and those of the prediction's credibility; none if ideal."""
        if self.ideal:
            return ()
        source, ours = "paper 2", "extension: published is none"

        def share(name: str, value: float, source: str, meaning: str) -> Parameter:
            return Parameter(f"credibility.{name}", value, Interval(), "1", source, meaning=meaning)

        def number(name: str, unit: str, bound: Bounded, meaning: str) -> Parameter:
            return Parameter(f"credibility.{name}", 0.0, bound, unit, ours, meaning=meaning)

        return (
            share("rate", 0.1, "calibrated; paper 2 gives none", "rate of the averaged variances"),
            Parameter("credibility.power", 1.0, Positive(), "1", source, meaning="power p"),
            number("floor", "m^2", Bounded(), "added to the averaged variances"),
            number("followed", "1", Bounded(high=1.0, scale=0.3),
                   "how much of the information follows the averaged variances"),
            number("kappa", "1", Bounded(scale=10.0),
                   "how much common drift raises the process noise"),
            share("drift_rate", 0.05, ours, "rate of the averaged drift"),
        )  # fmt: skip

    def memory(self, mean: Tensor, channels: int) -> dict[str, Tensor]:
        """Variances as declared, no drift."""
        lead = mean.shape[:-1]
        return {
            RATIO: mean.new_ones(*lead, channels),
            VARIANCE: mean.new_ones(*lead, channels),
            DRIFT: mean.new_zeros(*lead, self.axes),
        }

    def before_predict(
        self, memory: Memory, process: Tensor, inputs: Memory, constants: Constants
    ) -> Tensor:
        """Process noise raised where the systems drift off together."""
        if self.ideal:
            level, own = inputs["ideal.process"], constants["motion.factor"][0, 0]
            factor = torch.where(torch.isnan(level), own, level) / own
            return process * factor[..., None, None]
        rate = constants["credibility.drift_rate"]
        drift = memory[DRIFT].square().mean(-1) * (2.0 - rate) / rate
        growth = 1.0 + constants["credibility.kappa"] * (drift - 1.0).clamp_min(0.0)
        return process * growth.sqrt()[..., None, None]

    def before_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        present: Tensor,
        inputs: Memory,
        constants: Constants,
    ) -> tuple[Linearised, Memory]:
        """R of each system such that it counts its share of the information."""
        nominal = inputs["ideal.variance"] if self.ideal else linearised.total
        if self.ideal:
            averaged, ratio = inputs["ideal.error"].square(), memory[RATIO]
        else:
            rate = constants["credibility.rate"]
            fresh = linearised.innovation.square() / nominal
            ratio = torch.where(present, (1.0 - rate) * memory[RATIO] + rate * fresh, memory[RATIO])
            averaged = ratio * nominal
        weight = self.weights(linearised.observed, nominal, averaged, present, constants)
        noise = nominal / weight
        adapted = linearised._replace(independent=noise, total=noise)
        return adapted, {**memory, RATIO: ratio, VARIANCE: averaged}

    def weights(
        self,
        observed: Tensor,
        nominal: Tensor,
        averaged: Tensor,
        present: Tensor,
        constants: Constants,
    ) -> Tensor:
        """(..., m), factor on each channel's information, equal within a system.

        Args:
            observed: (..., m, k); nominal, averaged: R and R' (..., m); present (..., m).
        """
        spread = square_norms(observed)
        each = torch.stack([spread, spread / nominal, averaged, nominal])
        geometry, t, total, declared = self.pooled(torch.where(present, each, 0.0)).unbind(0)
        count = self.pooled(present.to(spread.dtype))
        here = count > 0.0
        divisor = count.clamp_min(1.0)
        own, declared = (total + LEAST * declared) / divisor, declared / divisor
        gamma = self.shares(geometry, own, here, constants)
        counted = t
        if not self.ideal:
            followed = constants["credibility.followed"]
            counted = t * (1.0 - followed + followed * declared / torch.where(here, own, 1.0))
        usable = here & (t > 0.0)
        weight = gamma * counted.sum(-1, keepdim=True) / torch.where(usable, t, 1.0)
        weight = torch.where(usable, weight, 1.0)
        weight = weight.clamp_min(LEAST)  # R = infinity would have no gradient
        if self.single:
            return weight
        place = {channel: i for i, system in enumerate(self.systems) for channel in system}
        return weight[..., [place[channel] for channel in range(len(place))]]

    @property
    def single(self) -> bool:
        """Whether each system is one channel, in order."""
        return self.systems == tuple((i,) for i in range(len(self.systems)))

    def pooled(self, x: Tensor) -> Tensor:
        """Sums over each system's channels, (..., m) -> (..., N)."""
        if self.single:
            return x
        return torch.stack([x[..., [*system]].sum(-1) for system in self.systems], dim=-1)

    def shares(
        self, geometry: Tensor, averaged: Tensor, present: Tensor, constants: Constants
    ) -> Tensor:
        """gamma (..., N): positive where present, 0 elsewhere, their sum 1 (0 with none present).

        Args:
            geometry: a_i (..., N); averaged: R'_i (..., N), above 0; present (..., N).
        """
        power, floor = torch.ones_like(averaged[..., :1]), torch.zeros_like(averaged[..., :1])
        if not self.ideal:
            power, floor = constants["credibility.power"], constants["credibility.floor"]
        tiny = torch.finfo(averaged.dtype).tiny
        variance = torch.where(present, averaged + floor, 1.0)
        score = geometry.clamp_min(tiny).log() - power * variance.log()
        score = torch.where(present, score, -torch.inf)
        nobody = ~present.any(-1, keepdim=True)
        gamma = torch.softmax(torch.where(nobody, 0.0, score), dim=-1)
        return torch.where(nobody, 0.0, gamma)

    def after_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        conditioned: Conditioned,
        weight: Tensor,
        present: Tensor,
        constants: Constants,
    ) -> Memory:
        """Average of the shift of the position, in its standard deviations."""
        if self.ideal:
            return memory
        position = conditioned.deviations[..., : self.axes, :]
        gain = (position @ conditioned.observed.mT) * (weight / linearised.independent)[
            ..., None, :
        ]
        variance = (gain.square() * memory[VARIANCE].unsqueeze(-2)).sum(-1)
        moved = variance > 0.0
        root = positive_sqrt(torch.where(moved, variance, 1.0))
        u = torch.where(moved, conditioned.shift[..., : self.axes] / root, 0.0)
        rate = constants["credibility.drift_rate"]
        drift = (1.0 - rate) * memory[DRIFT] + rate * u
        measured = present.any(-1, keepdim=True)
        return {**memory, DRIFT: torch.where(measured, drift, memory[DRIFT])}
