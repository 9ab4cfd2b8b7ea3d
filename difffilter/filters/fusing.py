"""One row of the distributed fusion: what subsystems hand on, and how they update."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.core.compression import compress
from difffilter.core.conditioning import condition
from difffilter.core.innovation import innovation_variance
from difffilter.core.linearised import Linearised
from difffilter.parameters.values import Constants
from difffilter.sensors.sensor import Sensor

__all__ = ["Row", "at", "keep", "moved", "own_belief", "record_of", "update"]


@dataclass(frozen=True)
class Row:
    """What the subsystems predict and hand on in one row.

    Attributes:
        sensors: one for each subsystem, the robust one's first.
        prior, present: of each subsystem, linearised at its own prediction.
        information: (..., m) of each sensor; nothing of the others' where the row is flagged.
        flag: (...), q of the robust subsystem; estimate: (..., n), x_R.
    """

    sensors: tuple[Sensor, ...]
    constants: Constants
    measurement: Measurement
    prior: list[Linearised]
    present: list[Tensor]
    information: list[Tensor]
    flag: Tensor
    estimate: Tensor

    @property
    def clear(self) -> Tensor:
        """(...), 1 - q."""
        return 1.0 - self.flag

    @cached_property
    def own_value(self) -> Tensor:
        """(..., m), what the robust subsystem predicts at its estimate."""
        return self.predicted(0, self.estimate)

    def predicted(self, i: int, mean: Tensor) -> Tensor:
        """(..., m), what sensor i should read."""
        return self.sensors[i].predict(mean, self.measurement.inputs, self.constants)

    def about(self, i: int, mean: Tensor) -> Tensor:
        """(..., m), sensor i's innovation about a mean; 0 where missing."""
        there, size = self.predicted(i, mean), len(self.sensors[0].channels)
        z = self.measurement.z[..., i * size : (i + 1) * size]
        return self.sensors[i].residual(torch.where(self.present[i], z, there), there)

    def handed(self, mean: Tensor) -> Tensor:
        """The robust subsystem's measurement, or its own value, minus what is predicted."""
        own = self.sensors[0].residual(self.own_value, self.predicted(0, mean))
        return self.clear.unsqueeze(-1) * self.about(0, mean) + self.flag.unsqueeze(-1) * own

    def joined(self, linear: Linearised, which: list[int]) -> tuple[Linearised, Tensor]:
        """Information-weighted innovation and noise of the robust sensor and others."""
        information = self.information
        total = information[0] + sum((information[i] for i in which), torch.zeros(()))
        known = total > 0.0
        noise = 1.0 / torch.where(known, total, 1.0)
        innovation = information[0] * self.handed(linear.mean)
        for i in which:
            innovation = innovation + information[i] * self.about(i, linear.mean)
        merged = linear._replace(innovation=innovation * noise, independent=noise, total=noise)
        return merged, known


def at(linear: Linearised, mean: Tensor) -> Linearised:
    """Linearised at another mean with the same covariance."""
    return linear.again(mean, linear.factor)


def update(linear: Linearised, known: Tensor) -> Belief:
    """Conditioned on the channels that are known."""
    weight = known.to(linear.mean.dtype)
    done = condition(
        linear.deviations, linear.observed, linear.innovation, weight, linear.independent
    )
    deviations = done.deviations
    if deviations.shape[-1] > deviations.shape[-2]:
        deviations = compress(deviations)
    return Belief(linear.mean + done.shift, deviations)


def keep(memory: Mapping[str, Tensor], i: int, belief: Belief) -> dict[str, Tensor]:
    """The memory with the belief of subsystem i."""
    return {
        **memory,
        f"fusion.mean.{i}": belief.mean,
        f"fusion.deviations.{i}": belief.deviations,
    }


def own_belief(memory: Mapping[str, Tensor], i: int) -> Belief:
    """The belief of subsystem i."""
    return Belief(memory[f"fusion.mean.{i}"], memory[f"fusion.deviations.{i}"])


def moved(d: Tensor, linear: Linearised, constants: Constants) -> Tensor:
    """(...), whether a prediction was corrected; between 0 and 1 in training."""
    size = d.abs().amax(-1)
    temperature = constants.get("temperature")
    if temperature is None:
        return (size > 0.0).to(size.dtype)
    bound = linear.innovation_variance.sqrt().amin(-1)
    scaled = size / (temperature * bound)
    return scaled / (1.0 + scaled)


def record_of(row: Row, output: Linearised) -> Record:
    """Nominal innovations of all sensors about the fused prediction."""
    count = len(row.sensors)
    innovation = torch.cat([row.about(i, output.mean) for i in range(count)], dim=-1)
    observed = torch.cat([output.observed] * count, dim=-2)
    noise = torch.cat([linear.independent for linear in row.prior], dim=-1)
    here = torch.cat(row.present, dim=-1)
    weight = torch.cat(row.information, dim=-1) * noise
    return Record(
        innovation=innovation,
        observed=observed,
        noise=noise,
        standardised=innovation * innovation_variance(observed, noise).rsqrt(),
        weight=weight,
        prior_weight=torch.ones_like(output.mean),
        gate=row.clear.unsqueeze(-1).expand_as(weight),
        modes=weight[..., :0],
        present=here,
        isolated=torch.zeros_like(here),
    )
