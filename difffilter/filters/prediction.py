"""Predict a belief and linearise the measurement there, by either rule."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.adaptation.protocol import Adaptation
from difffilter.core.beliefs import Belief, Measurement
from difffilter.core.compression import compress
from difffilter.core.cubature import doubled, moments
from difffilter.core.linalg import join, product, semidefinite_cholesky
from difffilter.core.linearised import Linearised
from difffilter.filters.recipe import Modelled
from difffilter.motions.protocol import Motion
from difffilter.motions.retraction import cloud, lifted, moved
from difffilter.parameters.values import Constants
from difffilter.sensors.information import block_diagonal
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.wrapped import seen

__all__ = ["Predicted", "linearise", "predict", "predict_covariance"]


class Predicted(NamedTuple):
    """A predicted belief: mean and compressed deviations, and what these are made of."""

    mean: Tensor
    deviations: Tensor
    moved: Tensor
    process: Tensor
    transition: Callable[[Tensor], Tensor]


def predict(
    recipe: Modelled,
    constants: Constants,
    belief: Belief,
    measurement: Measurement,
    adaptation: Adaptation | None = None,
) -> Predicted:
    """Mean f(m) and deviations compress([F X, G L_Q]) at the measurement's time.

    With cubature and a motion that is not linear: mean and deviations of the moved points.
    """
    motion, dt, inputs = recipe.motion, measurement.dt, measurement.inputs
    if recipe.linearise == "cubature" and not motion.linear:
        mean, ahead = _moved_points(motion, belief, dt, inputs, constants)
    else:
        mean = motion.transition(belief.mean, dt, inputs, constants)
        ahead = motion.propagate(belief.mean, belief.deviations, dt, inputs, constants)
    process = motion.noise(belief.mean, dt, inputs, constants)
    # No time, no step: noise per step adds nothing either.
    process = torch.where((dt > 0.0)[..., None, None], process, 0.0)
    if adaptation is not None:
        process = adaptation.before_predict(belief.memory, process, inputs, constants)

    def transition(columns: Tensor) -> Tensor:
        return motion.propagate(belief.mean, columns, dt, inputs, constants)

    return Predicted(mean, compress(ahead, process), ahead, process, transition)


def predict_covariance(
    recipe: Modelled,
    constants: Constants,
    mean: Tensor,
    covariance: Tensor,
    measurement: Measurement,
) -> Predicted | None:
    """The same from a covariance (..., n, n): F P F^T + Q, factored once.

    None where deviations are needed before the step: points, a state on a manifold. What moved
    is told as the whole: an adaptation that asks for F X has no use of it.
    """
    motion, dt, inputs = recipe.motion, measurement.dt, measurement.inputs
    if (recipe.linearise == "cubature" and not motion.linear) or not motion.flat:
        return None

    def transition(columns: Tensor) -> Tensor:
        return motion.propagate(mean, columns, dt, inputs, constants)

    process = motion.noise(mean, dt, inputs, constants)
    process = torch.where((dt > 0.0)[..., None, None], process, 0.0)
    ahead = transition(transition(covariance).mT) + product(process, process.mT)
    factor = semidefinite_cholesky(ahead)
    moved = motion.transition(mean, dt, inputs, constants)
    return Predicted(moved, factor, factor, process, transition)


def _moved_points(
    motion: Motion, belief: Belief, dt: Tensor, inputs: Mapping[str, Tensor], constants: Constants
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
    recipe: Modelled,
    constants: Constants,
    predicted: Predicted,
    measurement: Measurement,
    foretold: bool = False,
) -> tuple[Linearised, Tensor]:
    """Innovation and deviations of all channels, and which are present.

    ``foretold``: whether faults are told by the inputs (see ``clairvoyant`` of a filter).
    """
    z = seen(recipe.sensors, measurement.z, measurement.inputs)
    measurement = measurement._replace(z=z)
    present = ~torch.isnan(z)

    def again(mean: Tensor, deviations: Tensor) -> Linearised:
        here = predicted._replace(mean=mean, deviations=deviations)
        return _linearise(
            recipe=recipe,
            constants=constants,
            predicted=here,
            measurement=measurement,
            present=present,
            again=again,
            foretold=foretold,
        )

    if foretold:
        present = present & torch.isfinite(measurement.inputs["fault.variance"])
    return again(predicted.mean, predicted.deviations), present


def _linearise(
    recipe: Modelled,
    constants: Constants,
    predicted: Predicted,
    measurement: Measurement,
    present: Tensor,
    again: Callable[[Tensor, Tensor], Linearised],
    foretold: bool,
) -> Linearised:
    """Innovation and deviations of all sensors' channels, noise common to channels included."""
    inputs, mean, deviations = measurement.inputs, predicted.mean, predicted.deviations
    cubature = recipe.linearise == "cubature"
    motion = recipe.motion
    points = cloud(motion, mean, deviations) if cubature else mean
    columns = deviations if cubature else lifted(motion, mean, deviations)
    innovations, observed, independent, total, common = [], [], [], [], []
    at = 0
    for sensor in recipe.sensors:
        here = slice(at, at := at + len(sensor.channels))
        if cubature:
            value, z_deviations = _at_points(sensor, mean, points, inputs, constants)
        else:
            value, z_deviations = sensor.observe(mean, columns, inputs, constants)
        z = torch.where(present[..., here], measurement.z[..., here], value)
        noise = sensor.noise(mean, inputs, constants)
        innovations.append(sensor.residual(z, value))
        observed.append(z_deviations)
        independent.append(noise.independent.expand_as(value))
        total.append(noise.total.expand_as(value))
        common.append(noise.common)
    if cubature:
        deviations = doubled(deviations)
    innovation, r, r_total = (_join(parts, -1, 1) for parts in (innovations, independent, total))
    if foretold:
        innovation, extra = _without_faults(innovation, present, inputs)
        r, r_total = r + extra, r_total + extra
    z_deviations = _join(observed, -2, 2)
    shared = block_diagonal(common)
    count = shared.shape[-1]
    if count:
        shared = shared.expand(*mean.shape[:-1], -1, -1)
        z_deviations = torch.cat([z_deviations, shared], dim=-1)
        deviations = torch.nn.functional.pad(deviations, (0, count))
    return Linearised(
        mean=mean,
        deviations=deviations,
        innovation=innovation,
        observed=z_deviations,
        independent=r,
        total=r_total,
        common=count,
        moved=predicted.moved,
        process=predicted.process,
        transition=predicted.transition,
        dt=measurement.dt,
        again=again,
    )


def _without_faults(
    innovation: Tensor, present: Tensor, inputs: Mapping[str, Tensor]
) -> tuple[Tensor, Tensor]:
    """Innovation less the faults' means, and what their variances add to R, each (..., m)."""
    variance = inputs["fault.variance"]
    known = torch.isfinite(variance)
    left = torch.where(present & known, innovation - inputs["fault.mean"], 0.0)
    return left, torch.where(known, variance, 0.0)


def _at_points(
    sensor: Sensor, mean: Tensor, cloud: Tensor, inputs: Mapping[str, Tensor], constants: Constants
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
