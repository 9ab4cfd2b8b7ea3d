"""The sensors of a scenario: their models for the filter, and their true noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Generator, Tensor

from difffilter.parameters.parameters import Number
from difffilter.scenario.table import Table
from difffilter.sensors.builtin import TDOA, Bearing, Position, PositionSensor, Range, StationSensor

__all__ = ["KINDS", "SensorSpec", "read_sensor"]

MODELS: dict[str, type[PositionSensor]] = {
    "tdoa": TDOA,
    "range": Range,
    "bearing": Bearing,
    "position": Position,
}
KINDS = tuple(MODELS)


@dataclass(frozen=True)
class Schedule:
    """Another noise level for steps first <= k <= last."""

    first: int
    last: int
    sigma: float


@dataclass(frozen=True)
class SensorSpec:
    """One sensor: geometry and channels (``model``), and its noise in the world, in m or rad.

    Attributes:
        model: with the world's sigma; a filter gets it through :meth:`for_filter`.
        sigma: standard deviation of the independent noise, in the world.
        common_sigma: of the noise that all channels share, in the world (TDOA only).
        schedule: other levels of ``sigma`` for stretches of the trajectory.
        pool: names of the sensors whose measurements it combines, for a derived one.
        every: it measures at every so many-th step of the world.
    """

    model: PositionSensor
    sigma: float
    common_sigma: float
    schedule: tuple[Schedule, ...]
    every: int = 1
    pool: tuple[str, ...] = ()

    @property
    def platform(self) -> tuple[str, ...]:
        """Names of the inputs with the position of its platform."""
        return self.model.platform if isinstance(self.model, StationSensor) else ()

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

    def measure(
        self, truth: Tensor, generator: Generator, inputs: Mapping[str, Tensor]
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Measurements of the truth (T, B, n); row 0 is step 1.

        Returns:
            Noisy and exact ones, and the noise's variance, each (T, B, m).
        """
        constants = self.model.prepare({p.name: p.tensor() for p in self.model.parameters})
        exact = self.model.predict(truth, inputs, constants)
        level = torch.full((truth.shape[0], 1, 1), self.sigma, dtype=torch.float64)
        for part in self.schedule:
            level[max(part.first, 1) - 1 : part.last] = part.sigma
        white = torch.randn(exact.shape, generator=generator, dtype=torch.float64)
        shared = torch.randn(exact[..., :1].shape, generator=generator, dtype=torch.float64)
        variance = (level.square() + self.common_sigma**2).expand_as(exact)
        noisy = exact + level * white + self.common_sigma * shared
        silent = torch.arange(1, len(truth) + 1) % self.every != 0
        noisy = torch.where(silent[:, None, None], torch.nan, noisy)
        return noisy, exact, variance


def read_sensor(name: str, table: Table, axes: int) -> SensorSpec:
    """Read ``[sensors.NAME]``."""
    kind = table.text("kind", choices=KINDS)
    noise = table.table("noise", optional=True)
    unit = noise.unit(MODELS[kind].unit)
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
    about: dict[str, Any] = {
        "name": name,
        "axes": axes,
        "sigma": sigma,
        "channels": table.names("channels", ()),
    }
    every = table.integer("every", 1, low=1)
    pool = table.names("pool", ()) if kind == "position" else ()
    about |= {} if kind == "position" else _read_stations(table, kind, axes)
    expected = axes if kind == "position" else len(about["stations"]) - (kind == "tdoa")
    if about["channels"] and len(about["channels"]) != expected:
        table.fail("channels", f"{expected} names")
    table.finish()
    return SensorSpec(MODELS[kind](**about), sigma, common, tuple(schedule), every, pool)


def _read_stations(table: Table, kind: str, axes: int) -> dict[str, Any]:
    """Where the stations are, and the platform that they may ride."""
    if kind == "bearing" and axes != 2:
        table.fail("kind", "no bearing in a scenario without two axes")
    if kind == "bearing" and "stations" not in table:
        stations: tuple[tuple[float, ...], ...] = ((0.0,) * axes,)
        table.take("stations", "", None)
    else:
        stations = table.points("stations")
    heights = kind != "bearing"
    if len(stations[0]) != axes and not (heights and len(stations[0]) == axes + 1):
        with_heights = f", or with heights {axes + 1}," if heights else ""
        table.fail("stations", f"points of {axes}{with_heights} numbers")
    if kind == "tdoa" and len(stations) < 3:
        table.fail("stations", "three or more stations, the reference first")
    platform = table.names("platform", ())
    if platform and len(platform) != len(stations[0]):
        table.fail("platform", f"{len(stations[0])} names of inputs, one per coordinate")
    height = {"height": table.number("height", 0.0)} if heights else {}
    return {"stations": stations, "platform": platform, **height}
