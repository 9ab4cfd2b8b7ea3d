"""Predict a belief and linearise the measurement there, by either rule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement
from difffilter.core.compression import compress
from difffilter.core.cubature import moments
from difffilter.core.linalg import join
from difffilter.core.linearised import Linearised
from difffilter.filters.filter import Filter
from difffilter.motions.protocol import Motion
from difffilter.motions.retraction import cloud, lifted, moved
from difffilter.parameters.parameters import Values
from difffilter.sensors.information import block_diagonal
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
        mean, ahead = _moved_points(motion, belief, dt, inputs, constants)
    else:
        mean = motion.transition(belief.mean, dt, inputs, constants)
        ahead = motion.propagate(belief.mean, belief.deviations, dt, inputs, constants)
    process = motion.noise(belief.mean, dt, inputs, constants)
    if filter.adaptation is not None:
        process = filter.adaptation.before_predict(belief.memory, process, inputs, constants)

    def transition(columns: Tensor) -> Tensor:
        return motion.propagate(belief.mean, columns, dt, inputs, constants)

    return Predicted(mean, compress(ahead, process), ahead, process, transition)


def _moved_points(
    motion: Motion, belief: Belief, dt: Tensor, inputs: Mapping[str, Tensor], constants: Values
) -> tuple[Tensor, Tensor]:
    """Mean and deviations (..., p, 2p) of the moved cubature points."""
    points = cloud(motion, belief.mean, belief.deviations)
    ahead = motion.transition(points, dt, inputs, constants)
    if motion.flat:
        return moments(ahead)
    centre = motion.transition(belief.mean, dt, inputs, constants)
    offset, deviations = moments(motion.local(centre.expand_as(ahead), ahead))
    return moved(motion, centre, offset, deviations)


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
    motion = filter.motion
    points = cloud(motion, mean, deviations) if cubature else mean
    columns = deviations if cubature else lifted(motion, mean, deviations)
    innovations, observed, independent, total, common = [], [], [], [], []
    at = 0
    for sensor in filter.sensors:
        here = slice(at, at := at + len(sensor.channels))
        if cubature:
            predicted, z_deviations = _at_points(sensor, mean, points, inputs, constants)
        else:
            predicted, z_deviations = sensor.observe(mean, columns, inputs, constants)
        z = torch.where(present[..., here], measurement.z[..., here], predicted)
        noise = sensor.noise(mean, inputs, constants)
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
    shared = block_diagonal(common)
    count = shared.shape[-1]
    if count:
        shared = shared.expand(*mean.shape[:-1], -1, -1)
        z_deviations = torch.cat([z_deviations, shared], dim=-1)
        deviations = torch.nn.functional.pad(deviations, (0, count))
    return Linearised(mean, deviations, innovation, z_deviations, r, r_total, count), present


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
