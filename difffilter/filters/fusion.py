"""Distributed fusion of one robust and several adaptive subsystems, without feedback (paper 4)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from difffilter.adaptation.correction import PredictionCorrection, corrected, excess
from difffilter.adaptation.matching import FLAG, MATCHED, InnovationMatching
from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.core.linearised import Linearised
from difffilter.core.merge import merged_estimate
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.fusing import Row, at, keep, moved, own_belief, record_of, update
from difffilter.filters.prediction import linearise, predict
from difffilter.filters.recipe import Modelled
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants
from difffilter.sensors.information import common_noise

__all__ = ["Fusion"]


@dataclass(frozen=True)
class Fusion(Modelled):
    """One robust subsystem on the first sensor, adaptive ones on the others (paper 4, (f)).

    All sensors measure the same quantities. Every subsystem keeps its own belief; each row:

    1. Each predicts from its own posterior.
    2. The robust one matches its innovations' covariance (:class:`InnovationMatching`): flag q,
       matched noise R_R, estimate x_R. What it hands on is its measurement if q = 0, else what
       it predicts at x_R; with q = 1 the other sensors' information counts nothing.
    3. Each adaptive one weighs that and its own sensor by their information, corrects its
       prediction (:class:`PredictionCorrection`, with the robust one's streak) and updates.
    4. Fused prediction: P_t^-1 = mean of P_A^-1, x_t = P_t mean(P_A^-1 x_A), corrected ones.
    5. If q = 0 and an adaptive one corrected, the robust one takes x_t as its prior mean and
       updates; else it keeps x_R.
    6. Output: x_t, P_t conditioned on all sensors' information. Nothing is fed back.

    [P] the architecture, [R] the formulas. Flags are soft in training. The update is
    :func:`difffilter.condition` throughout; so is step 4, where one prediction is a measurement
    of the state with the other's covariance.

    Attributes:
        motion, sensors, linearise, start_sigma, overrides, tuned: as for a filter.
        axes: positions, the first states.
        window: of the matching, rows.

    Raises:
        InputError: fewer than three sensors, sensors of different kinds, noise common to
            channels; and as for a filter.

    Example:
        >>> from difffilter import ConstantVelocity, Fusion, Position
        >>> sensors = tuple(Position(name=name, sigma=3.0) for name in ("r", "a1", "a2"))
        >>> "correction.lambda" in Fusion(ConstantVelocity(2), sensors).declarations
        True
    """

    axes: int = 2
    window: int = 4

    def __post_init__(self, tuned: Sequence[str] | None) -> None:
        self._place()
        kinds = {(type(sensor), len(sensor.channels)) for sensor in self.sensors}
        if len(self.sensors) < 3 or len(kinds) > 1:
            raise InputError("fusion: expected three sensors or more of one kind and size")
        for sensor in self.sensors:
            if common_noise(sensor):
                raise InputError("fusion: found noise common to channels, expected independent")
        super().__post_init__(tuned)

    @property
    def iterations(self) -> int:
        """How often a step conditions beyond once: twice for each subsystem."""
        return 0

    @cached_property
    def matching(self) -> InnovationMatching:
        """Of the robust subsystem."""
        return InnovationMatching(self.window)

    @cached_property
    def correction(self) -> PredictionCorrection:
        """Of the adaptive subsystems."""
        return PredictionCorrection(self.axes)

    @property
    def _more_parameters(self) -> tuple[Parameter, ...]:
        return (*self.matching.parameters, *self.correction.parameters)

    @cached_property
    def subsystems(self) -> tuple[Filter, ...]:
        """One plain filter per sensor, of the same motion and linearisation."""
        return tuple(
            Filter(self.motion, (sensor,), linearise=self.linearise) for sensor in self.sensors
        )

    def start(self, mean: Tensor, deviations: Tensor) -> Belief:
        """Initial belief; the memory is the matching's, and a belief for each subsystem."""
        memory = self.matching.memory(mean, len(self.sensors[0].channels))
        for i in range(len(self.sensors)):
            memory = keep(memory, i, Belief(mean, deviations))
        return Belief(mean, deviations, memory)

    def step(
        self, constants: Constants, belief: Belief, measurement: Measurement
    ) -> tuple[Belief, Record]:
        """One row, as :func:`difffilter.step`; see the class."""
        streak = belief.memory[MATCHED]
        row, robust, memory = self._predicted(constants, belief.memory, measurement)
        means, factors, kept = [], [], torch.ones_like(row.flag)
        for i in range(1, len(self.sensors)):
            merged, known = row.joined(row.prior[i], [i])
            d = excess(merged, known, constants)
            kept = kept * (1.0 - moved(d, merged, constants))
            again = at(row.prior[i], corrected(merged, d, known, self.axes, streak))
            means.append(again.mean)
            factors.append(again.factor)
            merged, known = row.joined(again, [i])
            memory = keep(memory, i, update(merged, known))
        fused_mean, fused_factor = _mean_information(means, factors)
        # The robust subsystem: the fused mean where it is trusted and somebody corrected.
        step_to = (row.clear * (1.0 - kept)).unsqueeze(-1)
        again = at(row.prior[0], row.prior[0].mean + step_to * (fused_mean - row.prior[0].mean))
        again = again._replace(independent=robust.independent, total=robust.total)
        memory = keep(memory, 0, update(again, row.present[0]))
        output = row.prior[0].again(fused_mean, fused_factor)
        merged, known = row.joined(output, list(range(1, len(self.sensors))))
        final = update(merged, known)
        return Belief(final.mean, final.deviations, memory), record_of(row, output)

    def _predicted(
        self, constants: Constants, memory: Mapping[str, Tensor], measurement: Measurement
    ) -> tuple[Row, Linearised, Mapping[str, Tensor]]:
        """What each subsystem predicts, and the robust one's matched noise and flag."""
        parts = self.subsystems
        size = len(parts[0].channels)
        prior: list[Linearised] = []
        present: list[Tensor] = []
        for i, part in enumerate(parts):
            rows = measurement._replace(z=measurement.z[..., i * size : (i + 1) * size])
            predicted = predict(part, constants, own_belief(memory, i), rows)
            linear, here = linearise(part, constants, predicted, rows)
            prior.append(linear)
            present.append(here)
        robust, memory = self.matching.before_condition(
            memory, prior[0], present[0], measurement.inputs, constants
        )
        clear = 1.0 - memory[FLAG]
        information = [present[0] / robust.independent]
        information += [
            clear.unsqueeze(-1) * here / linear.independent
            for linear, here in zip(prior[1:], present[1:], strict=True)
        ]
        row = Row(
            sensors=tuple(part.sensors[0] for part in parts),
            constants=constants,
            measurement=measurement,
            prior=prior,
            present=present,
            information=information,
            flag=memory[FLAG],
            estimate=update(robust, present[0]).mean,
        )
        return row, robust, memory


def _mean_information(means: list[Tensor], factors: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Mean and factor of P with P^-1 = mean of the P_i^-1."""
    mean, factor = means[0], factors[0]
    floor = mean.shape[-1] * torch.finfo(mean.dtype).eps  # P may be singular
    for other_mean, other in zip(means[1:], factors[1:], strict=True):
        mean, factor = merged_estimate(mean, factor, other_mean, other, floor)
    return mean, factor * len(means) ** 0.5
