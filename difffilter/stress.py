"""Conditions that nobody tuned for: more noise, more outliers, dropouts, a wrong start."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from difffilter.estimate import estimate, started
from difffilter.filter import Filter
from difffilter.log import Log, Start
from difffilter.metrics import mean_nees, paired_ratio, position_error, scored_rows
from difffilter.parameters import Values
from difffilter.scenario.scenario import Scenario
from difffilter.seeds import stream

__all__ = ["CONDITIONS", "Stressed", "stress"]

#: Levels of each condition; the first is the log as it is.
CONDITIONS: Mapping[str, tuple[str, tuple[float, ...]]] = {
    "noise": ("times the noise", (1.0, 1.5, 2.0, 3.0)),
    "outliers": ("share of measurements off by 5 to 20 sigma", (0.0, 0.05, 0.1, 0.2, 0.4)),
    "dropouts": ("share of measurements missing", (0.0, 0.2, 0.4, 0.6)),
    "start": ("sigmas by which each state of the start is off", (0.0, 1.0, 2.0, 3.0)),
}


@dataclass(frozen=True)
class Stressed:
    """Two sets of values under one condition at one level.

    Attributes:
        condition, level: see ``CONDITIONS``.
        published, tuned: position RMSE, m; nees: of both, per state.
        ratio: tuned / published, with its paired 95 % interval.
    """

    condition: str
    level: float
    published: float
    tuned: float
    nees: tuple[float, float]
    ratio: tuple[float, float, float]


def stress(
    scenario: Scenario,
    filter: Filter,
    log: Log,
    tuned: Values,
    *,
    temperature: float | None = None,
    seed: int = 0,
    engine: str = "auto",
) -> Iterator[Stressed]:
    """Published and tuned values on a log changed condition by condition.

    Noise and outliers are added in the sigmas of the published values.

    Args:
        log: held out, with truth.
    """
    for name, (_, levels) in CONDITIONS.items():
        for level in levels:
            changed = _CHANGE[name](filter, log, level, seed)
            squared, nees, rows = [], [], []
            for values in (filter.published(), tuned):
                ready = started(scenario, filter, changed, values)
                if name == "start":
                    ready = _moved(filter, ready, level, seed)
                with torch.no_grad():
                    track = estimate(filter, ready, values, temperature=temperature, engine=engine)
                rows.append(scored_rows(log, track, scenario.score))
                squared.append(position_error(log, track))
                nees.append(float(mean_nees(log, track, rows[-1])))
            both = rows[0] & rows[1]
            error = [float(x[both].mean().sqrt()) for x in squared]
            ratio = paired_ratio(squared[1], squared[0], both)
            yield Stressed(name, level, error[0], error[1], (nees[0], nees[1]), ratio)


def _sigma(filter: Filter) -> Tensor:
    """(m,), published standard deviation of each channel."""
    constants = filter.prepare()
    parts = [
        sensor.noise(constants).total.expand(len(sensor.channels)) for sensor in filter.sensors
    ]
    return torch.cat(parts).sqrt()


def _noisier(filter: Filter, log: Log, level: float, seed: int) -> Log:
    log = log.only(filter.channels)
    draw = torch.randn(log.z.shape, generator=stream(seed, "noise"), dtype=log.z.dtype)
    return replace(log, z=log.z + (level**2 - 1.0) ** 0.5 * _sigma(filter) * draw)


def _wilder(filter: Filter, log: Log, level: float, seed: int) -> Log:
    log = log.only(filter.channels)
    generator = stream(seed, "outliers")
    shape = log.z.shape
    hit = torch.rand(shape, generator=generator) < level
    size = 5.0 + 15.0 * torch.rand(shape, generator=generator, dtype=log.z.dtype)
    sign = torch.where(torch.rand(shape, generator=generator) < 0.5, -1.0, 1.0)
    return replace(log, z=torch.where(hit, log.z + sign * size * _sigma(filter), log.z))


def _sparser(filter: Filter, log: Log, level: float, seed: int) -> Log:
    log = log.only(filter.channels)
    gone = torch.rand(log.z.shape, generator=stream(seed, "dropouts")) < level
    return replace(log, z=torch.where(gone, torch.nan, log.z))


def _moved(filter: Filter, log: Log, level: float, seed: int) -> Log:
    """The started log, its start off by ``level`` sigmas in each state, either way."""
    start = log.start
    assert start is not None
    if start.covariance is None:
        sigma = filter.prepare()["start.sigma"].expand(start.mean.shape[-1])
    else:
        sigma = start.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    draw = torch.rand(start.mean.shape, generator=stream(seed, "start"), dtype=start.mean.dtype)
    mean = start.mean + level * torch.where(draw < 0.5, -sigma, sigma)
    return replace(log, start=Start(mean, start.covariance, start.time))


_CHANGE: Mapping[str, Callable[[Filter, Log, float, int], Log]] = {
    "noise": _noisier,
    "outliers": _wilder,
    "dropouts": _sparser,
    "start": lambda filter, log, level, seed: log.only(filter.channels),
}
