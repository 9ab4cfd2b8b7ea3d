"""The step that streaming, batch runs and training all execute.

Pure: torch operations of static shape on (..., n) tensors, no hidden state, no branch on a
tensor's value. Branches are on the recipe alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.belief import Belief, Measurement, Record
from difffilter.cubature import moments, points
from difffilter.filter import Filter
from difffilter.groups import spread
from difffilter.linalg import compress, join
from difffilter.linearised import Linearised
from difffilter.parameters import Values
from difffilter.recovery import STREAK, Recovery
from difffilter.sensor import Sensor
from difffilter.weighing import reweigh, weigh_once

__all__ = ["Predicted", "linearise", "predict", "step"]


def step(
    filter: Filter, constants: Values, belief: Belief, measurement: Measurement
) -> tuple[Belief, Record]:
    """One time step: predict to the measurement's time, linearise, weigh, condition.

    Args:
        filter: the recipe.
        constants: from :meth:`Filter.prepare`.
        belief: at the previous time, mean (..., n).
        measurement: z (..., m) with NaN where a channel is missing, dt, known inputs.

    Returns:
        The belief after the measurement, and the record of what was done. Nothing is checked
        here: a belief may turn out not finite (:func:`difffilter.run` raises then).
    """
    if filter.fusion is not None:
        return filter.fusion.step(filter, constants, belief, measurement)
    predicted = predict(filter, constants, belief, measurement)
    linear, present = linearise(filter, constants, predicted, measurement)
    isolated = None
    if filter.federated:
        linear, present, isolated = _isolate(filter, linear, present)
    memory, widening = belief.memory, None
    if filter.adaptation is not None:
        linear, memory = filter.adaptation.before_condition(
            memory, linear, present, measurement.inputs, constants
        )
    if filter.recovery is not None:
        streak = torch.where(present.any(-1), belief.memory[STREAK], 0.0)
        linear, widening = _recover(filter.recovery, streak, linear, constants)
    weigh = reweigh if filter.iterations else weigh_once
    conditioned, record = weigh(filter, constants, linear, present, widening)
    if filter.adaptation is not None:
        memory = filter.adaptation.after_condition(
            memory, linear, conditioned, record.weight, present, constants
        )
    if filter.recovery is not None:
        streak = filter.recovery.count(belief.memory[STREAK], record.weight, present)
        memory = {**memory, STREAK: streak}
    if isolated is not None:
        record = record._replace(isolated=isolated)
    n = linear.mean.shape[-1]
    posterior = conditioned.deviations[..., :n, :]
    if posterior.shape[-1] > n:  # common noise, cubature: static, by the recipe
        posterior = compress(posterior)
    return Belief(linear.mean + conditioned.shift[..., :n], posterior, memory), record


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


def _isolate(
    filter: Filter, linear: Linearised, present: Tensor
) -> tuple[Linearised, Tensor, Tensor]:
    """Take out whole sensors with anything that is not finite; the record names them."""
    finite = torch.isfinite(linear.innovation.square()) & torch.isfinite(linear.independent)
    finite = finite & torch.isfinite(linear.observed).all(-1)
    isolated = spread(filter.members, [~finite[..., [*own]].all(-1) for own in filter.members])
    sound = linear._replace(
        innovation=torch.where(isolated, 0.0, linear.innovation),
        observed=torch.where(isolated.unsqueeze(-1), 0.0, linear.observed),
        independent=torch.where(isolated, 1.0, linear.independent),
        total=torch.where(isolated, 1.0, linear.total),
    )
    return sound, present & ~isolated, isolated


def _recover(
    recovery: Recovery, streak: Tensor, linear: Linearised, constants: Values
) -> tuple[Linearised, Tensor | None]:
    """The predicted covariance grown, or the factor by which gate and weights are widened."""
    growth = recovery.growth(streak, constants)
    if recovery.action == "widen":
        return linear, growth
    columns = growth.sqrt().unsqueeze(-1).expand(*growth.shape, linear.own)
    columns = torch.nn.functional.pad(columns, (0, linear.common), value=1.0).unsqueeze(-2)
    grown = linear._replace(
        deviations=linear.deviations * columns, observed=linear.observed * columns
    )
    return grown, None


def _join(parts: list[Tensor], dim: int, core: int) -> Tensor:
    return parts[0] if len(parts) == 1 else join(parts, dim, core)
