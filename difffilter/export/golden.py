"""Golden vectors: what the torch filter makes of a short log, for the C code to repeat."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.checkpoint import Checkpoint
from difffilter.errors import InputError
from difffilter.estimate import started
from difffilter.filter import Filter
from difffilter.log import Log, Start
from difffilter.run import run
from difffilter.seeds import stream
from difffilter.simulate import simulate

__all__ = ["Golden", "golden"]

ROWS, SEED = 60, 7
#: Times the deviation of torch's own run in float32, and the least tolerance in float.
MARGIN, LEAST = 20.0, 1e-5


class Golden(NamedTuple):
    """Rows and what the filter believes after each.

    Attributes:
        log: one trajectory with missing channels and irregular times.
        dt: (T,); mean (n,) and deviations (n, n): of the start.
        means: (T, n); covariances: (T, n, n).
        tolerance: of double and of float, relative to the largest entry.
    """

    log: Log
    dt: Tensor
    mean: Tensor
    deviations: Tensor
    means: Tensor
    covariances: Tensor
    tolerance: tuple[float, float]


def golden(checkpoint: Checkpoint, known: tuple[str, ...]) -> Golden:
    """Rows of the scenario's world, or of a made-up straight walk where it has none.

    Args:
        known: names of the inputs that the step reads.
    """
    filter = checkpoint.published_filter
    log = _holed(_rows(checkpoint, filter, known))
    assert log.start is not None
    values, temperature = checkpoint.values, checkpoint.temperature
    covariance = log.start.covariance
    if covariance is None:
        sigma = filter.prepare(values)["start.sigma"].expand(len(filter.states))
        covariance = torch.diag(sigma.square())
    begin = replace(log, start=Start(log.start.mean, covariance, log.start.time))
    track = run(filter, begin, values, temperature=temperature, engine="torch")
    single = {name: value.float() for name, value in values.items()}
    rough = run(filter, begin.to(torch.float32), single, temperature=temperature, engine="torch")
    apart = [
        (a.double() - b).flatten(1).abs().amax(1) / b.flatten(1).abs().amax(1).clamp_min(1e-300)
        for a, b in ((rough.mean, track.mean), (rough.covariance, track.covariance))
    ]
    single_tolerance = max(MARGIN * float(torch.cat(apart).max()), LEAST)
    # Where the start is badly conditioned rounding grows in both precisions alike.
    finer = torch.finfo(torch.float64).eps / torch.finfo(torch.float32).eps
    tolerance = max(single_tolerance * finer, 1e-12), single_tolerance
    factor = torch.linalg.cholesky(covariance + 0.0) if _regular(covariance) else _root(covariance)
    dt = begin.intervals(log.start.time)
    return Golden(begin, dt, log.start.mean, factor, track.mean, track.covariance, tolerance)


def _regular(covariance: Tensor) -> bool:
    return int(torch.linalg.cholesky_ex(covariance).info) == 0


def _root(covariance: Tensor) -> Tensor:
    from difffilter.linalg import semidefinite_cholesky

    return semidefinite_cholesky(covariance)


def _rows(checkpoint: Checkpoint, filter: Filter, known: tuple[str, ...]) -> Log:
    """One trajectory of some rows, with a start."""
    scenario = checkpoint.scenario
    if scenario.world is None:
        return _walk(filter, checkpoint)
    log = started(scenario, filter, simulate(scenario, 1, SEED), checkpoint.values)
    assert log.start is not None
    covariance = log.start.covariance
    start = Start(log.start.mean[0], None if covariance is None else covariance[0], log.start.time)
    time = log.time if log.time.dim() == 1 else log.time[:, 0]
    inputs = {name: log.inputs[name] for name in known}
    inputs = {n: v[:, 0] if v.dim() > 1 and v.shape[1] == 1 else v for n, v in inputs.items()}
    return Log(
        log.channels, time[:ROWS], log.z[:ROWS, 0], inputs={n: v[:ROWS] for n, v in inputs.items()},
        start=start,
    )  # fmt: skip


def _walk(filter: Filter, checkpoint: Checkpoint) -> Log:
    """A straight walk of made-up measurements, for a filter of recordings."""
    generator = stream(SEED, "golden")
    constants = filter.prepare(checkpoint.values)
    n = len(filter.states)
    state = torch.full((n,), 1.5, dtype=torch.float64)
    time = torch.arange(1, ROWS + 1, dtype=torch.float64) * 0.1
    rows = []
    for _ in range(ROWS):
        state = filter.motion.transition(state, torch.tensor(0.1).double(), {}, constants)
        parts = [sensor.predict(state, {}, constants) for sensor in filter.sensors]
        noise = torch.cat([sensor.noise(constants).total.expand_as(p) for sensor, p in
                           zip(filter.sensors, parts, strict=True)])  # fmt: skip
        draw = torch.randn(len(noise), generator=generator, dtype=torch.float64)
        rows.append(torch.cat(parts) + noise.sqrt() * draw)
    mean = torch.full((n,), 1.0, dtype=torch.float64)
    return Log(filter.channels, time, torch.stack(rows), start=Start(mean, None, 0.0))


def _holed(log: Log) -> Log:
    """The log with missing channels, an empty row and rows left out."""
    generator = stream(SEED, "holes")
    missing = torch.rand(log.z.shape, generator=generator) < 0.15
    missing[min(5, log.steps - 1)] = True
    z = torch.where(missing, torch.nan, log.z)
    kept = [i for i in range(log.steps) if i % 9 != 4]
    if len(kept) < 2:
        raise InputError("export: found too few rows to test on, expected a longer world")
    inputs = {name: value[kept] for name, value in log.inputs.items()}
    return replace(log, time=log.time[kept], z=z[kept], inputs=inputs)
