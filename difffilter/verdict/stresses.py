"""Conditions that nobody tuned for: more noise, more outliers, dropouts, a wrong start."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace

import torch

from difffilter.comparison.held_out import HeldOut, Outcome
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.parameters.parameters import Values
from difffilter.scenario.case import Case
from difffilter.scoring.truth import measurement_errors, nominal_sigma
from difffilter.seeds import stream

__all__ = ["CONDITIONS", "Grid", "Stressed", "stress", "stress_grid"]

#: Levels of each condition; the log as it is among them.
CONDITIONS: Mapping[str, tuple[str, tuple[float, ...]]] = {
    "noise": ("times the noise", (0.5, 1.0, 1.5, 2.0, 3.0)),
    "outliers": ("share of measurements off by 5 to 20 sigma", (0.0, 0.05, 0.1, 0.2, 0.4)),
    "dropouts": ("share of measurements missing", (0.0, 0.2, 0.4, 0.6)),
    "start": ("sigmas by which each state of the start is off", (0.0, 1.0, 2.0, 3.0)),
}
#: Inputs of simulated logs that tell what faults did.
FAULTS = ("fault.mean", "fault.variance")


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
    scenario: Case,
    filter: Recipe,
    log: Log,
    tuned: Values,
    *,
    temperature: float | None = None,
    seed: int = 0,
    engine: str = "auto",
) -> Iterator[Stressed]:
    """Published and tuned values on a log changed condition by condition.

    Noise and outliers are added in the sigmas of the published values. Noise below 1 scales
    the error of every measurement whose truth is known: in simulated logs of those that no
    fault struck, in recordings, where nobody knows, of all.

    Args:
        log: held out, with truth.
    """
    for name, (_, levels) in CONDITIONS.items():
        for level in levels:
            changed = _CHANGE[name](filter, log, level, seed)
            held = HeldOut(scenario, filter, changed, temperature, engine)

            def start(ready: Log, off: float = level * (name == "start")) -> Log:
                return _moved(filter, ready, off, seed)

            yield _stressed(name, level, held.outcome(None, start), held.outcome(tuned, start))


@dataclass(frozen=True)
class Grid:
    """Two sets of values over noise (rows) and outliers (columns).

    Attributes:
        noise, outliers: levels, as in ``CONDITIONS``.
        published: position RMSE of the published values, m.
        ratio: tuned / published.
    """

    noise: tuple[float, ...]
    outliers: tuple[float, ...]
    published: tuple[tuple[float, ...], ...]
    ratio: tuple[tuple[float, ...], ...]


def stress_grid(
    scenario: Case,
    filter: Recipe,
    log: Log,
    tuned: Values,
    *,
    temperature: float | None = None,
    seed: int = 0,
    engine: str = "auto",
) -> Grid:
    """Published and tuned values under noise and outliers together; as :func:`stress`."""
    noise, outliers = CONDITIONS["noise"][1], CONDITIONS["outliers"][1]
    rows = []
    for level in noise:
        noisier = _noisier(filter, log, level, seed)
        for share in outliers:
            changed = _wilder(filter, noisier, share, seed)
            held = HeldOut(scenario, filter, changed, temperature, engine)
            rows.append(_stressed("grid", share, held.outcome(), held.outcome(tuned)))
    lines = [rows[i : i + len(outliers)] for i in range(0, len(rows), len(outliers))]
    return Grid(
        noise,
        outliers,
        tuple(tuple(x.published for x in line) for line in lines),
        tuple(tuple(x.ratio[0] for x in line) for line in lines),
    )


def _stressed(name: str, level: float, published: Outcome, tuned: Outcome) -> Stressed:
    """Both over the rows that both have."""
    both = published.rows & tuned.rows
    error = [float(x.squared[both].mean().sqrt()) for x in (published, tuned)]
    nees = (published.nees, tuned.nees)
    return Stressed(name, level, error[0], error[1], nees, tuned.ratio(published))


def _noisier(filter: Recipe, log: Log, level: float, seed: int) -> Log:
    log = log.only(filter.channels)
    if level < 1.0:
        errors = measurement_errors(filter, log).nan_to_num()
        if FAULTS[0] in log.inputs:  # simulated: which measurements are struck is known
            mean, variance = (log.inputs[name] for name in FAULTS)
            errors = torch.where((mean != 0.0) | (variance != 0.0), 0.0, errors)
        return replace(log, z=log.z - (1.0 - level) * errors)
    draw = torch.randn(log.z.shape, generator=stream(seed, "noise"), dtype=log.z.dtype)
    return replace(log, z=log.z + (level**2 - 1.0) ** 0.5 * nominal_sigma(filter, log) * draw)


def _wilder(filter: Recipe, log: Log, level: float, seed: int) -> Log:
    log = log.only(filter.channels)
    generator = stream(seed, "outliers")
    shape = log.z.shape
    hit = torch.rand(shape, generator=generator) < level
    size = 5.0 + 15.0 * torch.rand(shape, generator=generator, dtype=log.z.dtype)
    sign = torch.where(torch.rand(shape, generator=generator) < 0.5, -1.0, 1.0)
    return replace(log, z=torch.where(hit, log.z + sign * size * nominal_sigma(filter, log), log.z))


def _sparser(filter: Recipe, log: Log, level: float, seed: int) -> Log:
    log = log.only(filter.channels)
    gone = torch.rand(log.z.shape, generator=stream(seed, "dropouts")) < level
    return replace(log, z=torch.where(gone, torch.nan, log.z))


def _moved(filter: Recipe, log: Log, level: float, seed: int) -> Log:
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


_CHANGE: Mapping[str, Callable[[Recipe, Log, float, int], Log]] = {
    "noise": _noisier,
    "outliers": _wilder,
    "dropouts": _sparser,
    "start": lambda filter, log, level, seed: log.only(filter.channels),
}
