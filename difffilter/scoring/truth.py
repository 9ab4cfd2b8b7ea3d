"""What a log's truth says of its measurements and of the motion."""

from __future__ import annotations

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.parameters.parameters import Values
from difffilter.sensors.information import stacked_noise

__all__ = ["measurement_errors", "nominal_sigma", "true_states"]


def true_states(filter: Recipe, log: Log) -> Tensor:
    """(T, ..., n), the true states of a filter, without errors that last; NaN where unknown.

    A velocity that the log does not have is the central difference of its position.

    Raises:
        InputError: no truth, or a state that it does not tell.
    """
    if log.truth is None:
        raise InputError(
            "truth: found none, expected truth_x (and truth_y, truth_z) columns; without truth, "
            "inspect and run tell NIS and residuals"
        )
    truth = dict(zip(log.truth_states, log.truth.unbind(-1), strict=True))
    for name in filter.bare_states:
        if name not in truth:
            if name[:1] != "v" or name[1:] not in truth:
                raise InputError(f"truth: found no truth_{name}, expected every state's")
            truth[name] = _rate(truth[name[1:]], log.time)
    return torch.stack([truth[name] for name in filter.bare_states], dim=-1)


def measurement_errors(filter: Recipe, log: Log, values: Values | None = None) -> Tensor:
    """(T, ..., m), measured minus true; NaN where missing or where truth is unknown.

    Args:
        values: of the filter's parameters; biases among them are taken off.

    Raises:
        InputError: as :func:`true_states`.
    """
    log = log.only(filter.channels)
    states, constants = true_states(filter, log), filter.prepare(values)
    parts, at = [], 0
    for sensor in filter.bare_sensors:
        z = log.z[..., at : at + len(sensor.channels)]
        parts.append(sensor.residual(z, sensor.predict(states, log.inputs, constants)))
        at += len(sensor.channels)
    return torch.cat(parts, dim=-1)


def nominal_sigma(filter: Recipe, log: Log, values: Values | None = None) -> Tensor:
    """(m,) or (T, ..., m), standard deviation of each channel's noise for the rows of a log.

    Noise that depends on the state is that of the true one; of a state of zeros where the log
    does not tell it.
    """
    constants = filter.prepare(values)
    known = set(log.truth_states) if log.truth is not None else set()
    if known.issuperset(filter.bare_states):
        mean = true_states(filter, log).nan_to_num()
    else:
        mean = torch.zeros(len(filter.bare_states), dtype=log.z.dtype)
    total = stacked_noise(filter.bare_sensors, mean, log.inputs, constants).total
    return (total.expand(len(filter.channels)) if total.dim() < 2 else total).sqrt()


def _rate(x: Tensor, time: Tensor) -> Tensor:
    """Central difference over time, one-sided at the ends."""
    time = time.reshape(len(time), *([1] * (x.dim() - 1)) if time.dim() == 1 else time.shape[1:])
    later, earlier = torch.cat([x[1:], x[-1:]]), torch.cat([x[:1], x[:-1]])
    after, before = torch.cat([time[1:], time[-1:]]), torch.cat([time[:1], time[:-1]])
    return (later - earlier) / (after - before)
