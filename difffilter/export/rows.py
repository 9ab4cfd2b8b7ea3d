"""Rows to test an exported filter on: where it works, disturbed, with holes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.motions.with_errors import SIGMA
from difffilter.parameters.parameters import Values
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scenario.estimation import started
from difffilter.scenario.simulation import simulate
from difffilter.scoring.truth import nominal_sigma
from difffilter.seeds import stream
from difffilter.sensors.information import stacked_noise
from difffilter.sensors.stations import StationSensor
from difffilter.sensors.varying import followed
from difffilter.sensors.wrapped import bare

__all__ = ["rows"]

ROWS = 60
#: A wild value, in sigmas; how often; rows in which all channels are wild, to be refused.
WILD, OFTEN, BURST = 25.0, 0.04, (36, 42)
#: Of a walk: seconds between rows; the start's sigma as a share of the stations' spread, and in
#: sigmas of the channels where there is no station.
DT, SHARE, SIGMAS = 0.1, 0.05, 10.0


def rows(checkpoint: Checkpoint, filter: Recipe, known: Sequence[str], seed: int) -> Log:
    """One trajectory with missing channels, irregular times and wild values, and its start.

    Of the scenario's world, or a walk among the stations where it has none.

    Args:
        filter: the checkpoint's, or the same relative to an origin.
        known: names of the inputs that the step reads.
    """
    values = checkpoint.values
    world = checkpoint.scenario.world is not None and filter is checkpoint.published_filter
    if world:
        log = _simulated(checkpoint, known, seed)
    else:
        given = getattr(checkpoint.scenario, "start", None)
        centre = given.mean if isinstance(given, Start) else _centre(filter)
        log = _walk(filter, values, known, seed, centre)
    log = _holed(_disturbed(log, filter, values, seed), seed)
    assert log.start is not None
    start = log.start
    own = start.covariance
    told = own is not None and not bool(torch.isnan(own).all())
    sigma = own.diagonal().sqrt() if own is not None and told else _sigma(filter, values, known)
    errors = filter.prepare(values).get(SIGMA, sigma[:0])  # a start need not tell of them
    mean = torch.nn.functional.pad(start.mean, (0, len(filter.states) - len(start.mean)))
    sigma = torch.cat([sigma, errors[len(errors) + len(sigma) - len(filter.error_states) :]])
    return replace(log, start=Start(mean, _correlated(sigma), start.time))


def _correlated(sigma: Tensor) -> Tensor:
    """A covariance in which every state tells of every other, so that each term counts."""
    n = len(sigma)
    share = 0.9 / (1.0 + 0.2 * torch.arange(n, dtype=torch.float64))
    correlation = torch.outer(share, share)
    correlation.fill_diagonal_(1.0)
    return torch.outer(sigma, sigma) * correlation


def _simulated(checkpoint: Checkpoint, known: Sequence[str], seed: int) -> Log:
    """Rows of the scenario's world."""
    scenario, filter = checkpoint.scenario, checkpoint.published_filter
    log = started(scenario, filter, simulate(scenario, 1, seed), checkpoint.values)
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


def _walk(filter: Recipe, values: Values, known: Sequence[str], seed: int, centre: Tensor) -> Log:
    """A straight walk that begins among the stations, or at the model's own start."""
    generator = stream(seed, "golden")
    constants = filter.prepare(values)
    scale, motion = _sigma(filter, values, known), filter.motion
    moved = torch.where(scale > 0.0, scale, 1.0)  # also where the start is certain
    state = motion.retract(centre, 1.5 * moved)
    time = torch.arange(1, ROWS + 1, dtype=torch.float64) * DT
    ramp = torch.linspace(0.0, float(scale.max()), ROWS, dtype=torch.float64)
    inputs = {name: ramp * (-1.0) ** i for i, name in enumerate(known)}  # across the target's way
    noisier = torch.linspace(0.5, 2.0, ROWS, dtype=torch.float64)
    inputs |= {name: noisier for name in followed(filter.sensors) if name in known}
    found = []
    for k in range(ROWS):
        row = {name: value[k] for name, value in inputs.items()}
        step = torch.tensor(DT, dtype=torch.float64)
        state = motion.transition(state, step, row, constants)
        parts = [sensor.predict(state, row, constants) for sensor in filter.sensors]
        noise = stacked_noise(filter.sensors, state, row, constants).total
        draw = torch.randn(len(noise), generator=generator, dtype=torch.float64)
        found.append(torch.cat(parts) + noise.sqrt() * draw)
    begin = motion.retract(centre, scale)
    if motion.flat:
        begin = torch.where(scale > 0.0, begin, state)
    start = Start(begin, None, 0.0)
    return Log(filter.channels, time, torch.stack(found), inputs=inputs, start=start)


def _stations(filter: Recipe) -> list[Tensor]:
    """Coordinates along the axes (stations, axes) of the fixed stations of each sensor."""
    return [
        torch.tensor(sensor.stations, dtype=torch.float64)[:, : sensor.axes]
        for sensor in map(bare, filter.sensors)
        if isinstance(sensor, StationSensor) and not sensor.platform
    ]


def _centre(filter: Recipe) -> Tensor:
    """The state (n,) amid the stations, at rest; zeros without stations."""
    centre = torch.zeros(len(filter.states), dtype=torch.float64)
    for stations in _stations(filter)[:1]:
        centre[: stations.shape[1]] = stations.mean(0)
    return centre


def _sigma(filter: Recipe, values: Values, known: Sequence[str]) -> Tensor:
    """Standard deviation (p,) of each error at the start: the filter's own, else a likely one."""
    constants = filter.prepare(values)
    n = len(filter.error_states)
    if "start.sigma" in constants:
        own = constants["start.sigma"].expand(len(filter.bare_states))
        return torch.cat([own, constants[SIGMA]]) if SIGMA in constants else own
    sigma = torch.ones(n, dtype=torch.float64)
    spread = [float((s - s.mean(0)).norm(dim=-1).max()) for s in _stations(filter)]
    axes = getattr(filter.sensors[0], "axes", n)
    zeros = dict.fromkeys(known, torch.zeros((), dtype=torch.float64))
    noise = stacked_noise(filter.sensors, _centre(filter), zeros, constants).total
    noisy = SIGMAS * float(noise.sqrt().max())
    sigma[:axes] = SHARE * max(spread) if any(spread) else noisy
    return sigma


def _disturbed(log: Log, filter: Recipe, values: Values, seed: int) -> Log:
    """The log with wild values, so that gates, weights and recovery have work."""
    sigma = nominal_sigma(filter, log, values)
    wild = torch.rand(log.z.shape, generator=stream(seed, "wild")) < OFTEN
    wild[BURST[0] : BURST[1]] = True
    return replace(log, z=log.z + WILD * sigma * wild)


def _holed(log: Log, seed: int) -> Log:
    """The log with missing channels, an empty row and rows left out."""
    missing = torch.rand(log.z.shape, generator=stream(seed, "holes")) < 0.15
    missing[min(5, log.steps - 1)] = True
    z = torch.where(missing, torch.nan, log.z)
    kept = [i for i in range(log.steps) if i % 9 != 4]
    if len(kept) < 2:
        raise InputError("export: found too few rows to test on, expected a longer world")
    inputs = {name: value[kept] for name, value in log.inputs.items()}
    return replace(log, time=log.time[kept], z=z[kept], inputs=inputs)
