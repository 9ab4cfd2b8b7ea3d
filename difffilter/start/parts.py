"""What a start asks of a recipe, and the sensors that make it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.parameters.parameters import Values
from difffilter.parameters.values import Constants
from difffilter.sensors.builtin import Position
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.wrapped import bare

__all__ = ["Part", "Startable", "needed_channels", "part_of"]


class Startable(Protocol):
    """What the start asks of a filter or another estimator."""

    @property
    def bare_states(self) -> tuple[str, ...]:
        """Names of the states without errors that last, the position first."""

    @property
    def kinds(self) -> Mapping[str, str]:
        """What each state is."""

    @property
    def bare_sensors(self) -> tuple[Sensor, ...]:
        """The measurement models, errors that last taken as noise."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the sensors' channels."""

    def published(self, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
        """Declared values."""

    def prepare(self, values: Values | None = None) -> Constants:
        """Constants from values."""


class Part(NamedTuple):
    """The sensors that make a start, as a recipe of their own."""

    states: tuple[str, ...]
    sensors: tuple[Sensor, ...]
    channels: tuple[str, ...]
    axes: int
    velocities: tuple[int, ...]


def part_of(recipe: Startable, names: Sequence[str] | None) -> Part:
    """The sensors named, all if None."""
    known = {getattr(sensor, "name", ""): sensor for sensor in recipe.bare_sensors}
    for name in names or ():
        if name not in known:
            raise InputError(f"sensors: found {name!r}, expected some of {', '.join(known)}")
    chosen = tuple(
        s for s in recipe.bare_sensors if names is None or getattr(s, "name", "") in names
    )
    if not chosen:
        raise InputError("sensors: found none, expected one or more")
    axes, states = _axes(recipe), recipe.bare_states
    moving = tuple(i for i, name in enumerate(states) if recipe.kinds[name] == "velocity")
    velocities = moving if len(moving) == axes else ()
    return Part(states, chosen, tuple(c for s in chosen for c in s.channels), axes, velocities)


def _axes(recipe: Startable) -> int:
    """Position components: as the built-in sensors say, else the first states that are some."""
    axes = [int(getattr(sensor, "axes", 0)) for sensor in recipe.bare_sensors]
    if max(axes, default=0):
        return max(axes)
    kinds = [recipe.kinds[name] for name in recipe.bare_states]
    return next((i for i, kind in enumerate(kinds) if kind != "position"), len(kinds))


def needed_channels(part: Part) -> int:
    """Channels that must have been seen: one more than axes unless a position is measured."""
    extra = 0 if any(isinstance(bare(sensor), Position) for sensor in part.sensors) else 1
    return min(part.axes + extra, len(part.channels))
