"""Predict a belief and linearise the measurement there, by either rule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement
from difffilter.core.compression import compress
from difffilter.core.cubature import moments, points
from difffilter.core.linalg import join
from difffilter.core.linearised import Linearised
from difffilter.filters.filter import Filter
from difffilter.parameters.parameters import Values
from difffilter.sensors.sensor import Sensor

__all__ = ["Predicted", "linearise", "predict"]


class Predicted(NamedTuple):
    """A predicted belief: mean and compressed deviations, and what these are made of."""

    mean: Tensor
    deviations: Tensor
    moved: Tensor
    process: Tensor
    transition: Callable[[Tensor], Tensor]


def predict(
    filter: Filter, constants: Values, belief: Belief, measurement: Measurement
) -> Predicted:
    """Mean f(m) and deviations compress([F X, G L_Q]) at the measurement's time.

    With cubature and a motion that is not linear: mean and deviations of the moved points.
    """
    motion, dt, inputs = filter.motion, measurement.dt, measurement.inputs
    if filter.linearise == "cubature" and not motion.linear:
        cloud = points(belief.mean, belief.deviations)
        mean, moved = moments(motion.transition(cloud, dt, inputs, constants))
    else:
        mean = motion.transition(belief.mean, dt, inputs, constants)
        moved = motion.propagate(belief.mean, belief.deviations, dt, inputs, constants)
    process = motion.noise(dt, constants)
    if filter.adaptation is not None:
        process = filter.adaptation.before_predict(belief.memory, process, inputs, constants)

    def transition(columns: Tensor) -> Tensor:
        return motion.propagate(belief.mean, columns, dt, inputs, constants)

    return Predicted(mean, compress(moved, process), moved, process, transition)


def linearise(
    filter: Filter, constants: Values, predicted: Predicted, measurement: Measurement
) -> tuple[Linearised, Tensor]:
    """Innovation and deviations of all channels, and which are present."""
    present = ~torch.isnan(measurement.z)

    def again(mean: Tensor, deviations: Tensor) -> Linearised:
        linear, _ = _linearise(filter, constants, mean, deviations, measurement, present)
        return linear._replace(
            moved=predicted.moved,
            process=predicted.process,
            transition=predicted.transition,
            dt=measurement.dt,
            again=again,
        )

    linear = again(predicted.mean, predicted.deviations)
    if filter.clairvoyant:
        present = present & torch.isfinite(measurement.inputs["fault.variance"])
    return linear, present


def _linearise(
    filter: Filter,
    constants: Values,
    mean: Tensor,
    deviations: Tensor,
    measurement: Measurement,
    present: Tensor,
) -> tuple[Linearised, Tensor]:
    """Innovation and deviations of all sensors' channels, noise common to channels included."""
    inputs = measurement.inputs
    cubature = filter.linearise == "cubature"
    cloud = points(mean, deviations) if cubature else mean
    innovations, observed, independent, total, common = [], [], [], [], []
    at = 0
    for sensor in filter.sensors:
        here = slice(at, at := at + len(sensor.channels))
        if cubature:
            predicted, z_deviations = _at_points(sensor, mean, cloud, inputs, constants)
        else:
            predicted, z_deviations = sensor.observe(mean, deviations, inputs, constants)
        z = torch.where(present[..., here], measurement.z[..., here], predicted)
        noise = sensor.noise(constants)
        innovations.append(sensor.residual(z, predicted))
        observed.append(z_deviations)
        independent.append(noise.independent.expand_as(predicted))
        total.append(noise.total.expand_as(predicted))
        common.append(noise.common)
    if cubature:
        deviations = torch.cat([deviations, -deviations], dim=-1) * 0.5**0.5
    innovation, r, r_total = (_join(parts, -1, 1) for parts in (innovations, independent, total))
    if filter.clairvoyant:
        variance = inputs["fault.variance"]
        known = torch.isfinite(variance)
        present = present & known
        extra = torch.where(known, variance, 0.0)
        innovation = torch.where(present, innovation - inputs["fault.mean"], 0.0)
        r, r_total = r + extra, r_total + extra
    z_deviations = _join(observed, -2, 2)
    columns = sum(block.shape[-1] for block in common)
    if columns:
        shared = torch.block_diag(*common)  # type: ignore[no-untyped-call]
        shared = shared.expand(*mean.shape[:-1], -1, -1)
        z_deviations = torch.cat([z_deviations, shared], dim=-1)
        deviations = torch.nn.functional.pad(deviations, (0, columns))
    return Linearised(mean, deviations, innovation, z_deviations, r, r_total, columns), present


def _at_points(
    sensor: Sensor, mean: Tensor, cloud: Tensor, inputs: Mapping[str, Tensor], constants: Values
) -> tuple[Tensor, Tensor]:
    """Mean of the predicted values at cubature points, and their deviations (..., m, 2n).

    Through differences to the centre's value, so that angles average without a cut.
    """
    centre = sensor.predict(mean, inputs, constants)
    values = sensor.predict(cloud, inputs, constants)
    offset, deviations = moments(sensor.residual(values, centre))
    return centre + offset, deviations


def _join(parts: list[Tensor], dim: int, core: int) -> Tensor:
    return parts[0] if len(parts) == 1 else join(parts, dim, core)
