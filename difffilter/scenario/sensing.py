"""The sensors of a scenario: their models for the filter, and their true noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Generator, Tensor

from difffilter.parameters import Number
from difffilter.scenario.table import Table
from difffilter.sensors import TDOA, Position, PositionSensor, Range

__all__ = ["KINDS", "SensorSpec", "read_sensor"]

KINDS = ("tdoa", "range", "position")


@dataclass(frozen=True)
class Schedule:
    """Another noise level for steps first <= k <= last."""

    first: int
    last: int
    sigma: float


@dataclass(frozen=True)
class SensorSpec:
    """One sensor: geometry and channels (``model``), and its noise in the world, in m.

    Attributes:
        model: with the world's sigma; a filter gets it through :meth:`for_filter`.
        sigma: standard deviation of the independent noise, in the world.
        common_sigma: of the noise that all channels share, in the world (TDOA only).
        schedule: other levels of ``sigma`` for stretches of the trajectory.
    """

    model: PositionSensor
    sigma: float
    common_sigma: float
    schedule: tuple[Schedule, ...]

    def for_filter(self, sigma: Number | None, bias: Number | None, common: bool) -> PositionSensor:
        """The model that a filter uses: published sigma and bias where given."""
        model = replace(
            self.model,
            sigma=self.sigma if sigma is None else sigma,
            bias=0.0 if bias is None else bias,
        )
        if common and isinstance(model, TDOA):
            model = replace(model, common_sigma=self.common_sigma or self.sigma)
        return model

    def measure(self, truth: Tensor, generator: Generator, inputs: Mapping[str, Tensor]) -> Tensor:
        """Noisy measurements (T, B, m) of the truth (T, B, n); row 0 is step 1."""
        constants = self.model.prepare({p.name: p.tensor() for p in self.model.parameters})
        exact = self.model.predict(truth, inputs, constants)
        level = torch.full((truth.shape[0], 1, 1), self.sigma, dtype=torch.float64)
        for part in self.schedule:
            level[max(part.first, 1) - 1 : part.last] = part.sigma
        white = torch.randn(exact.shape, generator=generator, dtype=torch.float64)
        shared = torch.randn(exact[..., :1].shape, generator=generator, dtype=torch.float64)
        return exact + level * white + self.common_sigma * shared


def read_sensor(name: str, table: Table, axes: int) -> SensorSpec:
    """Read ``[sensors.NAME]``."""
    kind = table.text("kind", choices=KINDS)
    noise = table.table("noise", optional=True)
    unit = noise.unit()
    sigma = unit * noise.number("sigma", 1.0 / unit, above=0.0)
    common = unit * noise.number("common_sigma", 0.0, low=0.0) if kind == "tdoa" else 0.0
    schedule = []
    for part in noise.tables("schedule"):
        schedule.append(
            Schedule(
                part.integer("first", low=1),
                part.integer("last", low=1),
                unit * part.number("sigma", above=0.0),
            )
        )
        if schedule[-1].last < schedule[-1].first:
            part.fail("last", f"a step of first = {schedule[-1].first} or later")
        part.finish()
    noise.finish()
    channels = table.names("channels", ())
    model: PositionSensor
    if kind == "position":
        if channels and len(channels) != axes:
            table.fail("channels", f"{axes} names")
        model = Position(name=name, axes=axes, channels=channels, sigma=sigma)
    else:
        stations = table.points("stations")
        if len(stations[0]) not in (axes, axes + 1):
            table.fail("stations", f"points of {axes}, or with heights {axes + 1}, numbers")
        if kind == "tdoa" and len(stations) < 3:
            table.fail("stations", "three or more stations, the reference first")
        height = table.number("height", 0.0)
        build = TDOA if kind == "tdoa" else Range
        if channels and len(channels) != len(stations) - (kind == "tdoa"):
            table.fail("channels", f"{len(stations) - (kind == 'tdoa')} names")
        model = build(
            name=name,
            axes=axes,
            channels=channels,
            sigma=sigma,
            stations=stations,
            height=height,
        )
    table.finish()
    return SensorSpec(model, sigma, common, tuple(schedule))
