"""Distributed fusion of one robust and several adaptive subsystems, without feedback (paper 4)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from difffilter.adaptation.correction import PredictionCorrection, corrected, excess
from difffilter.adaptation.matching import FLAG, MATCHED, InnovationMatching
from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.core.compression import compress
from difffilter.core.conditioning import condition
from difffilter.core.innovation import innovation_variance
from difffilter.core.linearised import Linearised
from difffilter.errors import InputError
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants
from difffilter.sensors.information import common_noise

if TYPE_CHECKING:
    from difffilter.filters.filter import Filter
    from difffilter.sensors.sensor import Sensor

__all__ = ["Fusion"]


@dataclass(frozen=True)
class Fusion:
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
        axes: positions, the first states.
        window: of the matching, rows.

    A filter with it raises InputError where it has fewer than three sensors, sensors of different
    kinds, or noise common to channels.
    """

    axes: int = 2
    window: int = 4

    @cached_property
    def matching(self) -> InnovationMatching:
        """Of the robust subsystem."""
        return InnovationMatching(self.window)

    @cached_property
    def correction(self) -> PredictionCorrection:
        """Of the adaptive subsystems."""
        return PredictionCorrection(self.axes)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those of matching and correction."""
        return (*self.matching.parameters, *self.correction.parameters)

    def check(self, sensors: tuple[Sensor, ...]) -> None:
        """InputError unless there are three sensors or more that measure the same."""
        kinds = {(type(sensor), len(sensor.channels)) for sensor in sensors}
        if len(sensors) < 3 or len(kinds) > 1:
            raise InputError("fusion: expected three sensors or more of one kind and size")
        for sensor in sensors:
            if common_noise(sensor):
                raise InputError("fusion: found noise common to channels, expected independent")

    def start(self, filter: Filter, mean: Tensor, deviations: Tensor) -> dict[str, Tensor]:
        """Memory: the matching's, and mean and deviations of each subsystem."""
        memory = self.matching.memory(mean, len(filter.sensors[0].channels))
        for i in range(len(filter.sensors)):
            memory |= {f"fusion.mean.{i}": mean, f"fusion.deviations.{i}": deviations}
        return memory

    def step(
        self, filter: Filter, constants: Constants, belief: Belief, measurement: Measurement
    ) -> tuple[Belief, Record]:
        """One row, as :func:`difffilter.step`."""
        from difffilter.filters.prediction import linearise, predict

        memory, parts = belief.memory, filter.subsystems
        size = len(parts[0].channels)
        prior: list[Linearised] = []
        present: list[Tensor] = []
        for i, part in enumerate(parts):
            own = Belief(memory[f"fusion.mean.{i}"], memory[f"fusion.deviations.{i}"])
            rows = measurement._replace(z=measurement.z[..., i * size : (i + 1) * size])
            predicted = predict(part, constants, own, rows)
            linear, here = linearise(part, constants, predicted, rows)
            prior.append(linear)
            present.append(here)
        streak = memory[MATCHED]
        robust, memory = self.matching.before_condition(
            memory, prior[0], present[0], measurement.inputs, constants
        )
        flag = memory[FLAG]
        clear = 1.0 - flag
        alone = _update(robust, present[0].to(flag.dtype), robust.innovation)
        own_value = _predicted(parts[0], alone.mean, measurement.inputs, constants)
        information = [present[0] / robust.independent]
        information += [
            clear.unsqueeze(-1) * here / linear.independent
            for linear, here in zip(prior[1:], present[1:], strict=True)
        ]

        def handed(linear: Linearised) -> Tensor:
            """The robust subsystem's measurement, or its own value, minus what is predicted."""
            there = _predicted(parts[0], linear.mean, measurement.inputs, constants)
            residual = parts[0].sensors[0].residual
            z = torch.where(present[0], measurement.z[..., :size], there)
            return clear.unsqueeze(-1) * residual(z, there) + flag.unsqueeze(-1) * residual(
                own_value, there
            )

        def about(linear: Linearised, i: int) -> Tensor:
            """Sensor i's innovation about another mean."""
            there = _predicted(parts[i], linear.mean, measurement.inputs, constants)
            z = measurement.z[..., i * size : (i + 1) * size]
            z = torch.where(present[i], z, there)
            return parts[i].sensors[0].residual(z, there)

        def joined(linear: Linearised, which: list[int]) -> tuple[Linearised, Tensor]:
            """Information-weighted innovation and noise of the robust sensor and others."""
            total = information[0] + sum((information[i] for i in which), torch.zeros(()))
            known = total > 0.0
            noise = 1.0 / torch.where(known, total, 1.0)
            innovation = information[0] * handed(linear)
            for i in which:
                innovation = innovation + information[i] * about(linear, i)
            merged = linear._replace(innovation=innovation * noise, independent=noise, total=noise)
            return merged, known

        means, factors, kept = [], [], torch.ones_like(flag)
        for i in range(1, len(parts)):
            merged, known = joined(prior[i], [i])
            d = excess(merged, known, constants)
            moved = corrected(merged, d, known, self.axes, streak)
            kept = kept * (1.0 - _moved(d, merged, constants))
            mean_again = _again(prior[i], moved)
            means.append(mean_again.mean)
            factors.append(_square(mean_again))
            merged, known = joined(mean_again, [i])
            posterior = _update(merged, known.to(flag.dtype), merged.innovation)
            memory = _keep(memory, i, posterior)
        fused_mean, fused_factor = _mean_information(means, factors)
        # The robust subsystem: the fused mean where it is trusted and somebody corrected.
        step_to = (clear * (1.0 - kept)).unsqueeze(-1)
        adopted = prior[0].mean + step_to * (fused_mean - prior[0].mean)
        again = _again(prior[0], adopted)
        again = again._replace(independent=robust.independent, total=robust.total)
        posterior = _update(again, present[0].to(flag.dtype), again.innovation)
        memory = _keep(memory, 0, posterior)

        output = _at(prior[0], fused_mean, fused_factor)
        merged, known = joined(output, list(range(1, len(parts))))
        final = _update(merged, known.to(flag.dtype), merged.innovation)
        # Nominal innovations of all sensors about the fused prediction.
        innovation = torch.cat([about(output, i) for i in range(len(parts))], dim=-1)
        observed = torch.cat([output.observed] * len(parts), dim=-2)
        noise = torch.cat([linear.independent for linear in prior], dim=-1)
        here = torch.cat(present, dim=-1)
        weight = torch.cat(information, dim=-1) * noise
        variance = innovation_variance(observed, noise)
        record = Record(
            innovation=innovation,
            observed=observed,
            noise=noise,
            standardised=innovation * variance.rsqrt(),
            weight=weight,
            prior_weight=torch.ones_like(output.mean),
            gate=clear.unsqueeze(-1).expand_as(weight),
            present=here,
            isolated=torch.zeros_like(here),
        )
        return Belief(final.mean, final.deviations, memory), record


def _predicted(
    part: Filter, mean: Tensor, inputs: Mapping[str, Tensor], constants: Constants
) -> Tensor:
    return part.sensors[0].predict(mean, inputs, constants)


def _square(linear: Linearised) -> Tensor:
    """X (..., n, n) of the prediction, from cubature's 2n columns too."""
    n, columns = linear.mean.shape[-1], linear.deviations[..., : linear.own]
    return columns if linear.own == n else columns[..., :n] * 2.0**0.5


def _again(linear: Linearised, mean: Tensor) -> Linearised:
    """Linearised at another mean with the same covariance."""
    return _at(linear, mean, _square(linear))


def _at(linear: Linearised, mean: Tensor, deviations: Tensor) -> Linearised:
    return linear.again(mean, deviations)


def _update(linear: Linearised, weight: Tensor, innovation: Tensor) -> Belief:
    done = condition(linear.deviations, linear.observed, innovation, weight, linear.independent)
    deviations = done.deviations
    if deviations.shape[-1] > deviations.shape[-2]:
        deviations = compress(deviations)
    return Belief(linear.mean + done.shift, deviations)


def _keep(memory: Mapping[str, Tensor], i: int, belief: Belief) -> dict[str, Tensor]:
    return {
        **memory,
        f"fusion.mean.{i}": belief.mean,
        f"fusion.deviations.{i}": belief.deviations,
    }


def _moved(d: Tensor, linear: Linearised, constants: Constants) -> Tensor:
    """(...), whether a prediction was corrected; between 0 and 1 in training."""
    size = d.abs().amax(-1)
    temperature = constants.get("temperature")
    if temperature is None:
        return (size > 0.0).to(size.dtype)
    bound = linear.innovation_variance.sqrt().amin(-1)
    scaled = size / (temperature * bound)
    return scaled / (1.0 + scaled)


def _mean_information(means: list[Tensor], factors: list[Tensor]) -> tuple[Tensor, Tensor]:
    """Mean and factor of P with P^-1 = mean of the P_i^-1."""
    mean, factor = means[0], factors[0]
    ones, zeros = torch.ones_like(mean), torch.zeros_like(mean)
    for other_mean, other in zip(means[1:], factors[1:], strict=True):
        done = condition(
            torch.cat([factor, torch.zeros_like(other)], dim=-1),
            torch.cat([factor, other], dim=-1),
            other_mean - mean,
            ones,
            zeros,
            floor=mean.shape[-1] * torch.finfo(mean.dtype).eps,  # P may be singular
        )
        mean, factor = mean + done.shift, compress(done.deviations)
    return mean, factor * len(means) ** 0.5
