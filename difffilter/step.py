"""The step that streaming, batch runs and training all execute.

Pure: torch operations of static shape on (..., n) tensors, no hidden state, no branch on a
tensor's value. Branches are on the recipe alone.
"""

from __future__ import annotations

import torch
from torch import Tensor

from difffilter.belief import Belief, Measurement, Record
from difffilter.condition import Conditioned, condition
from difffilter.filter import Filter, Linearised
from difffilter.linalg import compress, join, square_norms
from difffilter.parameters import Values

__all__ = ["predict", "step"]


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
        The belief after the measurement, and the record of what was done.
    """
    mean, deviations = predict(filter, constants, belief, measurement)
    present = ~torch.isnan(measurement.z)
    linear, present = _linearise(filter, constants, mean, deviations, measurement, present)
    memory = belief.memory
    if filter.adaptation is not None:
        linear, memory = filter.adaptation.before_condition(memory, linear, present, constants)
    if filter.iterations:
        conditioned, record = _reweigh(filter, constants, linear, present)
    else:
        conditioned, record = _weigh_once(filter, constants, linear, present)
    if filter.adaptation is not None:
        memory = filter.adaptation.after_condition(memory, linear, conditioned, present, constants)
    n = mean.shape[-1]
    posterior = conditioned.deviations[..., :n, :]
    if posterior.shape[-1] > n:  # columns of common noise: static, by the recipe
        posterior = compress(posterior)
    return Belief(linear.mean + conditioned.shift[..., :n], posterior, memory), record


def predict(
    filter: Filter, constants: Values, belief: Belief, measurement: Measurement
) -> tuple[Tensor, Tensor]:
    """Mean f(m) and deviations compress([F X, G L_Q]) at the measurement's time."""
    motion, dt, inputs = filter.motion, measurement.dt, measurement.inputs
    mean = motion.transition(belief.mean, dt, inputs, constants)
    moved = motion.propagate(belief.mean, belief.deviations, dt, inputs, constants)
    process = motion.noise(dt, constants)
    if filter.adaptation is not None:
        process = filter.adaptation.before_predict(belief.memory, process, constants)
    return mean, compress(moved, process)


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
    innovations, observed, independent, total, common = [], [], [], [], []
    at = 0
    for sensor in filter.sensors:
        here = slice(at, at := at + len(sensor.channels))
        predicted, z_deviations = sensor.observe(mean, deviations, inputs, constants)
        z = torch.where(present[..., here], measurement.z[..., here], predicted)
        noise = sensor.noise(constants)
        innovations.append(sensor.residual(z, predicted))
        observed.append(z_deviations)
        independent.append(noise.independent.expand_as(predicted))
        total.append(noise.total.expand_as(predicted))
        common.append(noise.common)
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


def _weigh_once(
    filter: Filter, constants: Values, linear: Linearised, present: Tensor
) -> tuple[Conditioned, Record]:
    """Weights from the nominal innovation, one conditioning."""
    variance = square_norms(linear.observed) + linear.independent
    scale = variance if filter.standardise == "innovation" else linear.total
    s = linear.innovation / scale.sqrt()
    weight, gate = _gated(filter, constants, filter.weight(s, constants, _soft(constants)), linear)
    weight = weight * present
    conditioned = _condition(linear, linear.deviations, linear.observed, weight)
    prior_weight = torch.ones_like(linear.mean)
    return conditioned, _record(linear, s, weight, prior_weight, gate, present)


def _reweigh(
    filter: Filter, constants: Values, linear: Linearised, present: Tensor
) -> tuple[Conditioned, Record]:
    """M-EKF: iteratively reweighted regression of [prediction; measurement].

    Paper 3, eqs. (15)-(27). Weighing the prediction scales the columns of the deviations
    by 1/sqrt(w_x); identity rows beside X carry the whitened prior residual, so that no
    system is solved.
    """
    n, k = linear.deviations.shape[-2:]
    deviations = linear.deviations
    if filter.weigh_prior:
        white = torch.eye(n, k, dtype=deviations.dtype, device=deviations.device)
        deviations = torch.cat([deviations, white.expand_as(deviations)], dim=-2)
    rows = deviations.shape[-2]
    if linear.common:  # rows of H X without the common noise: their shift is H (x - m)
        own = linear.observed[..., : k - linear.common]
        own = torch.nn.functional.pad(own, (0, linear.common))
        deviations = torch.cat([deviations, own], dim=-2)
    weight = present.to(deviations.dtype)
    gate = torch.ones_like(weight)
    prior_weight = torch.ones_like(linear.mean)
    s = linear.innovation
    spread = linear.total
    if filter.standardise == "innovation":
        spread = square_norms(linear.observed) + linear.independent
    conditioned = _condition(linear, deviations, linear.observed, weight)
    for _ in range(filter.iterations):
        residual = conditioned.residual
        if linear.common:
            residual = linear.innovation - conditioned.shift[..., rows:]
        s = residual / spread.sqrt()
        prior_s = -conditioned.shift[..., n:rows]
        if filter.mad:
            scale = _mad_scale(torch.cat([torch.where(present, s, torch.nan), prior_s], dim=-1))
            s, prior_s = s / scale, prior_s / scale
        weight, gate = _gated(
            filter, constants, filter.weight(s, constants, _soft(constants)), linear
        )
        weight = weight * present
        columns = torch.ones_like(deviations[..., 0, :])
        if filter.weigh_prior:
            floor = constants["prior.floor"]
            prior_weight = floor + (1.0 - floor) * filter.weight(
                prior_s, constants, _soft(constants)
            )
            columns = torch.cat([prior_weight.rsqrt(), columns[..., n:]], dim=-1)
        columns = columns.unsqueeze(-2)
        conditioned = _condition(linear, deviations * columns, linear.observed * columns, weight)
    return conditioned, _record(linear, s, weight, prior_weight, gate, present)


def _condition(
    linear: Linearised, deviations: Tensor, observed: Tensor, weight: Tensor
) -> Conditioned:
    """Condition so that a weight means R_ii -> R_ii / w, also for the common part of R."""
    noise = linear.independent
    if linear.common:
        noise = noise + (1.0 - weight) * (linear.total - linear.independent)
    return condition(deviations, observed, linear.innovation, weight, noise)


def _gated(
    filter: Filter, constants: Values, weight: Tensor, linear: Linearised
) -> tuple[Tensor, Tensor]:
    if filter.gate is None:
        return weight, torch.ones_like(weight)
    variance = square_norms(linear.observed) + linear.independent
    nis = linear.innovation.square() / variance
    share = linear.total / variance
    return filter.gate.weigh(weight, nis, constants, _soft(constants), share)


def _mad_scale(residuals: Tensor) -> Tensor:
    """1.48 times the median absolute deviation over the last axis, NaN left out."""
    spread = _median((residuals - _median(residuals)).abs())
    spread = torch.where(torch.isnan(spread), 1.0, spread)  # no row at all
    # With most residuals equal the deviation is 0: keep the scale away from it.
    return (1.48 * spread).clamp_min(1e-3)


def _median(x: Tensor) -> Tensor:
    """Median over the last axis, NaN left out: the mean of the middle two of an even number."""
    low = x.nanmedian(dim=-1, keepdim=True).values
    high = -(-x).nanmedian(dim=-1, keepdim=True).values
    return 0.5 * (low + high)


def _record(
    linear: Linearised, s: Tensor, weight: Tensor, prior: Tensor, gate: Tensor, present: Tensor
) -> Record:
    return Record(
        linear.innovation, linear.observed, linear.independent, s, weight, prior, gate, present
    )


def _join(parts: list[Tensor], dim: int, core: int) -> Tensor:
    return parts[0] if len(parts) == 1 else join(parts, dim, core)


def _soft(constants: Values) -> Tensor | None:
    return constants.get("temperature")
