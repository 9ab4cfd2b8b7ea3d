"""The sensors of a scenario: their models for the filter, and their true noise."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Generator, Tensor

from difffilter.parameters.parameters import Number
from difffilter.scenario.keys import keywords, made, published, read_keys
from difffilter.scenario.table import Table
from difffilter.sensors.registry import SENSORS
from difffilter.sensors.stations import StationSensor

__all__ = ["SensorSpec", "read_sensor"]

#: Keyword arguments of a sensor that are no keys of its table.
GIVEN = ("name", "axes", "sigma", "bias", "common_sigma")


@dataclass(frozen=True)
class Stretch:
    """Another noise level for steps first <= k <= last."""

    first: int
    last: int
    sigma: float


@dataclass(frozen=True)
class SensorSpec:
    """One sensor: what makes its model, and its noise in the world, in m or rad.

    Attributes:
        kind: name in :data:`SENSORS`; arguments: of what makes the model, but for noise and bias.
        model: with the world's sigma; a filter gets it through :meth:`for_filter`.
        sigma: standard deviation of the independent noise, in the world.
        common_sigma: of the noise that all channels share, in the world (TDOA only).
        schedule: other levels of ``sigma`` for stretches of the trajectory.
        pool: names of the sensors whose measurements it combines, for a derived one.
        every: it measures at every so many-th step of the world.
    """

    kind: str
    arguments: Mapping[str, Any]
    model: Any
    sigma: float
    common_sigma: float
    schedule: tuple[Stretch, ...]
    every: int = 1
    pool: tuple[str, ...] = ()

    @property
    def platform(self) -> tuple[str, ...]:
        """Names of the inputs with the position of its platform."""
        return self.model.platform if isinstance(self.model, StationSensor) else ()

    def for_filter(self, values: Mapping[str, Number], common: bool) -> Any:
        """The model that a filter uses: with published values, by parameter, where given."""
        factory = SENSORS[self.kind]
        sigma = {"sigma": self.sigma} if "sigma" in keywords(factory) else {}
        more = published(factory, self.model.name, values)
        if common and "common_sigma" in keywords(factory):
            more = {"common_sigma": self.common_sigma or self.sigma} | more
        elif "common_sigma" in more:
            del more["common_sigma"]  # told apart by common_noise of the system
        return factory(**dict(self.arguments) | sigma | more)

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
    kind = table.text("kind", choices=tuple(SENSORS))
    factory = SENSORS[kind]
    own = keywords(factory)
    about = {k: v for k, v in (("name", name), ("axes", axes)) if k in own}
    about |= read_keys(table, factory, GIVEN)
    blank = {"sigma": 1.0} if "sigma" in own else {}  # until its unit is known
    model = made(table, factory, about | blank)
    noise = table.table("noise", optional=True)
    unit = noise.unit(model.unit)
    sigma = unit * noise.number("sigma", 1.0 / unit, above=0.0)
    common = 0.0
    if "common_sigma" in own:
        common = unit * noise.number("common_sigma", 0.0, low=0.0)
    schedule = []
    for part in noise.tables("schedule"):
        schedule.append(
            Stretch(
                part.integer("first", low=1),
                part.integer("last", low=1),
                unit * part.number("sigma", above=0.0),
            )
        )
        if schedule[-1].last < schedule[-1].first:
            part.fail("last", f"a step of first = {schedule[-1].first} or later")
        part.finish()
    noise.finish()
    every = table.integer("every", 1, low=1)
    pool = table.names("pool", ()) if kind == "position" else ()
    table.finish()
    return SensorSpec(
        kind=kind,
        arguments=about,
        model=made(table, factory, about | ({"sigma": sigma} if blank else {})),
        sigma=sigma,
        common_sigma=common,
        schedule=tuple(schedule),
        every=every,
        pool=pool,
    )
