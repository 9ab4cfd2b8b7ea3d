"""Which states the errors of a recipe's sensors are, and which motion their delays follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.motions.protocol import Motion
from difffilter.motions.with_errors import SIGMA, WithErrors
from difffilter.parameters.values import Constants
from difffilter.sensors.delayed import Delayed
from difffilter.sensors.lasting import ErrorStates, Lasting, Place
from difffilter.sensors.position import PositionSensor
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.wrapped import Narrowed, Wrapped

__all__ = ["extended", "own_motion", "placed", "unplaced"]


def own_motion(motion: Motion) -> Motion:
    """The motion without the states of errors."""
    return motion.motion if isinstance(motion, WithErrors) else motion


def unplaced(sensor: Sensor) -> Sensor:
    """The sensor whose errors that last count as noise of the row; delays stay."""
    if isinstance(sensor, Narrowed):
        return unplaced(sensor.sensor)
    if isinstance(sensor, Lasting):
        return replace(sensor, sensor=unplaced(sensor.sensor), place=None)
    return sensor


def placed(motion: Motion, sensors: Sequence[Sensor]) -> tuple[Motion, tuple[Sensor, ...]]:
    """The motion with a state for each error that lasts, and sensors that read them there.

    Doing it again changes nothing. Sensors that may read any state are narrowed to the motion's
    own ones.

    Raises:
        InputError: two states of one name.
    """
    motion = own_motion(motion)
    sensors = tuple(_delayed(unplaced(sensor), motion) for sensor in sensors)
    if not any(isinstance(sensor, Lasting) for sensor in sensors):
        return motion, sensors
    size = at = len(motion.states)
    errors: list[ErrorStates] = []
    found: list[Sensor] = []
    for sensor in sensors:
        if isinstance(sensor, Lasting):
            found.append(replace(sensor, place=Place(size, at)))
            errors += sensor.errors
            at += sum(len(part.states) for part in sensor.errors)
        elif isinstance(sensor, PositionSensor):
            found.append(sensor)
        else:
            found.append(Narrowed(sensor, size))
    whole = WithErrors(motion, tuple(errors))
    twice = [name for name in whole.states if whole.states.count(name) > 1]
    if twice:
        raise InputError(f"states: found {twice[0]} twice, expected other names of sensors")
    return whole, tuple(found)


def _delayed(sensor: Sensor, motion: Motion) -> Sensor:
    """The sensor with its delay tied to the motion; errors that last stand outside of it."""
    if isinstance(sensor, Delayed):
        sensor = replace(sensor, motion=motion)
    if isinstance(sensor, Wrapped):
        inner = sensor.sensor
        if isinstance(inner, Lasting):
            raise InputError(
                f"{sensor.name}: found {type(sensor).__name__} around Lasting, expected Lasting "
                "outermost"
            )
        return sensor.with_sensor(_delayed(inner, motion))
    return sensor


def extended(
    motion: Motion | None, constants: Constants, mean: Tensor, deviations: Tensor
) -> tuple[Tensor, Tensor]:
    """A start of the motion's own states with the errors at 0, as uncertain as in the long run.

    Args:
        mean: (..., n); deviations: (..., p, p). Those of all states stay as they are.
    """
    if not isinstance(motion, WithErrors) or mean.shape[-1] != len(motion.motion.states):
        return mean, deviations
    sigma = constants[SIGMA]
    count, own = len(sigma), deviations.shape[-1]
    above = torch.nn.functional.pad(deviations, (0, count))
    below = torch.nn.functional.pad(torch.diag_embed(sigma), (own, 0))
    below = below.expand(*deviations.shape[:-2], -1, -1)
    return torch.nn.functional.pad(mean, (0, count)), torch.cat([above, below], dim=-2)
