"""Q and R alone, as they are estimated elsewhere: sample covariances, maximum likelihood."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.motions.blocks import ConstantVelocity
from difffilter.parameters.parameters import Parameter, as_number
from difffilter.scoring.truth import measurement_errors, true_states
from difffilter.sensors.sensor import NoiseAndBias
from difffilter.sensors.varying import varies
from difffilter.sensors.wrapped import bare
from difffilter.weights.registry import plain

__all__ = ["noise_names", "plain_filter", "sample_covariances"]

#: Least standard deviation from a sample, of the published one.
LEAST = 1e-3


def noise_names(filter: Recipe) -> tuple[str, ...]:
    """The tuned parameters that scale Q or R."""
    return tuple(n for n, p in filter.declarations.items() if p.tuned and p.noise)


def plain_filter(filter: Filter) -> Filter:
    """The Kalman filter of the same motion, sensors and start: nothing robust or adaptive."""
    simple = Filter(
        filter.motion, filter.sensors, plain,
        linearise=filter.linearise, start_sigma=filter.start_sigma,
    )  # fmt: skip
    kept = {n: p for n, p in filter.declarations.items() if n in simple.declarations}
    return replace(simple, overrides=kept)


def sample_covariances(filter: Filter, log: Log) -> dict[str, Tensor]:
    """Tuned values of Q and R from the errors that the truth shows.

    R of a sensor is the sample covariance of measured minus true, Q that of the true state
    minus its prediction from the true state before. Means are taken off.

    Args:
        log: with truth, for training.

    Returns:
        Values by name; a model of the user's own and noise common to channels are left out.
        No standard deviation is below ``LEAST`` of the published one: truth that never moves
        along an axis has none there, and no filter runs on that.

    Raises:
        InputError: as :func:`difffilter.scoring.truth.true_states`.
    """
    wanted = noise_names(filter)
    errors, found, at = measurement_errors(filter, log), {}, 0
    for sensor in filter.sensors:
        own = errors[..., at : at + len(sensor.channels)]
        at += len(sensor.channels)
        # Where the noise follows a column, sigma is not its spread.
        base = None if varies(sensor) else getattr(bare(sensor), "base", None)
        if isinstance(base, NoiseAndBias) and f"{base.name}.sigma" in wanted:
            found[f"{base.name}.sigma"] = _spread(own, filter.declarations[f"{base.name}.sigma"])
    motion = filter.bare_motion
    if isinstance(motion, ConstantVelocity):
        for name in ("motion.acceleration", "motion.state_sigma"):
            if name in wanted:
                found[name] = _spread(_drawn(filter, motion, log), filter.declarations[name])
    return found


def _drawn(filter: Filter, motion: ConstantVelocity, log: Log) -> Tensor:
    """(T - 1, ..., axes or n), the process noise that moved the true states, unscaled."""
    states = true_states(filter, log)
    time = log.time.reshape(
        len(log.time), *(log.time.shape[1:] or [1] * (states.dim() - 2))
    ).expand(states.shape[:-1])
    dt = torch.diff(time, dim=0)
    inputs = {name: value[1:] for name, value in log.inputs.items()}
    moved = motion.transition(states[:-1], dt, inputs, filter.prepare())
    noise = states[1:] - moved
    if motion.noise_kind == "state":
        return noise
    unit = dt if motion.noise_kind == "discrete" else dt.sqrt()
    return noise[..., motion.axes :] / unit.unsqueeze(-1)


def _spread(errors: Tensor, parameter: Parameter) -> Tensor:
    """Sample covariance in the shape that the parameter has; see ``LEAST``."""
    flat = errors.reshape(-1, errors.shape[-1])
    flat = flat - flat.nanmean(0)
    shape = torch.tensor(as_number(parameter.value)).shape
    if len(shape) == 2:
        whole = flat[torch.isfinite(flat).all(-1)]
        return whole.mT @ whole / len(whole)
    variance = flat.square().nanmean(0)
    spread = (variance if shape else variance.mean()).sqrt()
    return torch.maximum(spread, LEAST * parameter.tensor())
