"""A filter whose positions are relative to an origin, so that float has digits to spare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.filters.recipe import Modelled, Recipe
from difffilter.parameters.parameters import Values
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.stations import StationSensor
from difffilter.sensors.wrapped import bare, rewrapped

__all__ = ["relative"]

#: How well a model must hold when everything is moved by the origin, relative to its numbers.
CLOSE = 1e-6


def relative(filter: Recipe, values: Values, origin: Sequence[float]) -> Recipe:
    """The same filter, its stations told relative to ``origin`` (m, one number per axis).

    Beliefs, measured positions and known positions of platforms are then relative to it too.

    Raises:
        InputError: another number of coordinates; a motion or a sensor that is not the same
            everywhere, so that moving it changes what it says.
    """
    axes = max((getattr(sensor, "axes", 0) for sensor in filter.sensors), default=0)
    if len(origin) != axes:
        raise InputError(f"origin: found {len(origin)} coordinates, expected {axes}, one per axis")
    sensors = tuple(rewrapped(s, lambda inner: _moved(inner, origin)) for s in filter.sensors)
    if not isinstance(filter, Modelled):
        raise InputError("origin: found several filters at once, expected one with it")
    local = replace(filter, sensors=sensors)
    _check(filter, local, values, origin)
    return local


def _moved(sensor: Sensor, origin: Sequence[float]) -> Sensor:
    if not isinstance(sensor, StationSensor) or sensor.platform:
        return sensor
    ends = [*origin, *[0.0] * len(sensor.stations[0])]  # a height stays as it is
    stations = tuple(
        tuple(x - o for x, o in zip(station, ends, strict=False)) for station in sensor.stations
    )
    return replace(sensor, stations=stations)


def _check(filter: Recipe, local: Recipe, values: Values, origin: Sequence[float]) -> None:
    """Raise InputError unless both say the same, but for the origin in positions."""
    n, axes = len(filter.states), len(origin)
    shift = torch.zeros(n, dtype=torch.float64)
    shift[:axes] = torch.tensor(list(origin), dtype=torch.float64)
    inside = torch.linspace(1.0, 2.0, n, dtype=torch.float64)
    platforms = {
        name: float(o)
        for sensor in map(bare, filter.sensors)
        if isinstance(sensor, StationSensor)
        for name, o in zip(sensor.platform, origin, strict=False)
    }
    here: dict[str, Tensor] = {name: torch.zeros((), dtype=torch.float64) for name in platforms}
    there = {name: here[name] + o for name, o in platforms.items()}
    constants, own = filter.prepare(values), local.prepare(values)
    step = torch.ones((), dtype=torch.float64)
    size = CLOSE * float(shift.abs().max().clamp(min=1.0))
    far = filter.motion.transition(inside + shift, step, there, constants)
    near = local.motion.transition(inside, step, here, own)
    if not torch.allclose(far, near + shift, rtol=CLOSE, atol=size):
        raise InputError("origin: the motion is not the same everywhere, expected no origin")
    for sensor, other in zip(filter.sensors, local.sensors, strict=True):
        far = sensor.predict(inside + shift, there, constants)
        near = other.predict(inside, here, own)
        same = torch.allclose(far, near, rtol=CLOSE, atol=CLOSE)
        positions = len(far) == axes and torch.allclose(far, near + shift[:axes], atol=size)
        if not (same or positions):
            raise InputError(
                f"origin: {', '.join(sensor.channels)}: the sensor is not the same everywhere, "
                "expected no origin"
            )
