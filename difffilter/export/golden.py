"""Golden vectors: what the torch filter makes of a short log, for the C code to repeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scenario.estimation import started
from difffilter.scenario.simulation import simulate
from difffilter.scoring.truth import nominal_sigma
from difffilter.seeds import stream
from difffilter.sensors.information import stacked_noise

__all__ = ["Golden", "golden"]

ROWS, SEED = 60, 7
#: Times the deviation of torch's own run in float32, scaled to double's roundings and as it is,
#: and the least tolerance, in double and in float.
MARGIN, LEAST = (4.0, 20.0), (1e-12, 1e-5)
FINER = torch.finfo(torch.float64).eps / torch.finfo(torch.float32).eps
#: A wild value, in sigmas; how often; rows in which all channels are wild, to be refused.
WILD, OFTEN, BURST = 25.0, 0.04, (36, 42)


class Golden(NamedTuple):
    """Rows and what the filter believes after each.

    Attributes:
        log: one trajectory with missing channels and irregular times.
        dt: (T,); mean (n,) and deviations (n, n): of the start.
        means: (T, n); covariances: (T, n, n); weights: (T, m).
        tolerance: of double and of float, relative to the largest entry, and for the weights.
    """

    log: Log
    dt: Tensor
    mean: Tensor
    deviations: Tensor
    means: Tensor
    covariances: Tensor
    weights: Tensor
    tolerance: tuple[float, float]


def golden(checkpoint: Checkpoint, known: tuple[str, ...]) -> Golden:
    """Rows of the scenario's world, or of a made-up straight walk where it has none.

    Args:
        known: names of the inputs that the step reads.
    """
    filter, values = checkpoint.published_filter, checkpoint.values
    log = _holed(_disturbed(_rows(checkpoint, filter, known), filter, values))
    assert log.start is not None
    covariance = log.start.covariance
    if covariance is None:
        covariance = torch.diag(_sigma(filter, values).square())
    begin = replace(log, start=Start(log.start.mean, covariance, log.start.time))

    def track(log: Log, values: Values) -> Track:
        return run(filter, log, values, temperature=checkpoint.temperature, engine="torch")

    made = track(begin, values)
    rough = track(begin.to(torch.float32), {name: value.float() for name, value in values.items()})
    apart = _apart(rough, made)
    # Where the rows amplify rounding they do so in both precisions alike.
    double = max(MARGIN[0] * FINER * apart, LEAST[0])
    single = max(MARGIN[1] * apart, LEAST[1])
    factor = torch.linalg.cholesky(covariance) if _regular(covariance) else _root(covariance)
    return Golden(
        begin, begin.intervals(log.start.time), log.start.mean, factor,
        made.mean, made.covariance, _weights(made), (double, single),
    )  # fmt: skip


def _sigma(filter: Filter, values: Values) -> Tensor:
    """Standard deviation (n,) of each state at the start."""
    constants = filter.prepare(values)
    if "start.sigma" not in constants:
        raise InputError("export: found no covariance of the start, expected start.sigma")
    return constants["start.sigma"].expand(len(filter.states))


def _apart(found: Track, expected: Track) -> float:
    """What the self-test measures: the largest deviation of mean, covariance and weights."""
    pairs = ((found.mean, expected.mean), (found.covariance, expected.covariance))
    parts = [
        (a.double() - b).flatten(1).abs().amax(1) / b.flatten(1).abs().amax(1) for a, b in pairs
    ]
    parts.append((_weights(found).double() - _weights(expected)).flatten().abs())
    return float(torch.cat(parts).max())


def _weights(track: Track) -> Tensor:
    assert track.record is not None
    return track.record.weight


def _disturbed(log: Log, filter: Filter, values: Values) -> Log:
    """The log with wild values, so that gates, weights and recovery have work."""
    sigma = nominal_sigma(filter, log, values)
    generator = stream(SEED, "wild")
    wild = torch.rand(log.z.shape, generator=generator) < OFTEN
    wild[BURST[0] : BURST[1]] = True
    return replace(log, z=log.z + WILD * sigma * wild)


def _regular(covariance: Tensor) -> bool:
    return int(torch.linalg.cholesky_ex(covariance).info) == 0


def _root(covariance: Tensor) -> Tensor:
    from difffilter.core.linalg import semidefinite_cholesky

    return semidefinite_cholesky(covariance)


def _rows(checkpoint: Checkpoint, filter: Filter, known: tuple[str, ...]) -> Log:
    """One trajectory of some rows, with a start."""
    scenario = checkpoint.scenario
    if scenario.world is None:
        return _walk(filter, checkpoint, known)
    log = started(scenario, filter, simulate(scenario, 1, SEED), checkpoint.values)
    assert log.start is not None
    covariance = log.start.covariance
    start = Start(log.start.mean[0], None if covariance is None else covariance[0], log.start.time)
    time = log.time if log.time.dim() == 1 else log.time[:, 0]
    ramp = torch.linspace(0.0, 0.1, len(time), dtype=torch.float64)  # of what no world simulates
    inputs = {name: log.inputs.get(name, ramp) for name in known}
    inputs = {n: v[:, 0] if v.dim() > 1 else v for n, v in inputs.items()}
    return Log(
        log.channels, time[:ROWS], log.z[:ROWS, 0], inputs={n: v[:ROWS] for n, v in inputs.items()},
        start=start,
    )  # fmt: skip


def _walk(filter: Filter, checkpoint: Checkpoint, known: Sequence[str]) -> Log:
    """A straight walk of made-up measurements, for a filter of recordings."""
    generator = stream(SEED, "golden")
    constants = filter.prepare(checkpoint.values)
    scale = _sigma(filter, checkpoint.values)
    state = 1.5 * scale
    time = torch.arange(1, ROWS + 1, dtype=torch.float64) * 0.1
    ramp = torch.linspace(0.0, float(scale.max()), ROWS, dtype=torch.float64)
    inputs = {name: ramp * (-1.0) ** i for i, name in enumerate(known)}  # across the target's way
    rows = []
    for k in range(ROWS):
        row = {name: value[k] for name, value in inputs.items()}
        state = filter.motion.transition(state, torch.tensor(0.1).double(), row, constants)
        parts = [sensor.predict(state, row, constants) for sensor in filter.sensors]
        noise = stacked_noise(filter.sensors, state, row, constants).total
        draw = torch.randn(len(noise), generator=generator, dtype=torch.float64)
        rows.append(torch.cat(parts) + noise.sqrt() * draw)
    z = torch.stack(rows)
    return Log(filter.channels, time, z, inputs=inputs, start=Start(scale, None, 0.0))


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
