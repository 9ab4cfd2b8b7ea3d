"""Logs as they would be under other conditions: the same errors on another truth, or others.

Each change works on any log with truth, simulated or recorded: a measurement is what the sensors
predict from the truth plus an error, and either may be changed.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from difffilter.filters.recipe import Recipe
from difffilter.logs.log import PER_CHANNEL, Log, Start
from difffilter.motions.blocks import AXES
from difffilter.running.batch import start_belief
from difffilter.scoring.truth import measurement_errors, true_states
from difffilter.seeds import stream

__all__ = [
    "correlated",
    "denser",
    "losing_channels",
    "moved_start",
    "noisier",
    "pushed",
    "sparser",
    "sustained",
    "turned",
    "wilder",
]

#: Inputs of simulated logs that tell what faults did.
FAULTS = ("fault.mean", "fault.variance")
#: Rows over which an acceleration counts as sustained, and lasts.
ROWS = 10
#: Correlation of successive errors that takes the place of none.
CORRELATION = 0.8


def unstruck(filter: Recipe, log: Log) -> Tensor:
    """(T, ..., m), errors of the measurements; NaN where missing or where a fault struck.

    In recordings, where nobody knows what was struck, those of all.
    """
    errors = measurement_errors(filter, log)
    if FAULTS[0] in log.inputs:
        mean, variance = (log.inputs[name] for name in FAULTS)
        errors = torch.where((mean != 0.0) | (variance != 0.0), torch.nan, errors)
    return errors


def noisier(filter: Recipe, log: Log, level: float, seed: int) -> Log:
    """Errors that no fault struck, times ``level``."""
    log = log.only(filter.channels)
    return replace(log, z=log.z + (level - 1.0) * unstruck(filter, log).nan_to_num())


def wilder(filter: Recipe, log: Log, level: float, seed: int) -> Log:
    """A share ``level`` of the measurements off by 5 to 20 spreads of their errors."""
    log = log.only(filter.channels)
    generator = stream(seed, "outliers")
    shape = log.z.shape
    hit = torch.rand(shape, generator=generator) < level
    size = 5.0 + 15.0 * torch.rand(shape, generator=generator, dtype=log.z.dtype)
    sign = torch.where(torch.rand(shape, generator=generator) < 0.5, -1.0, 1.0)
    errors = unstruck(filter, log).reshape(-1, shape[-1])
    spread = 1.4826 * errors.abs().nanmedian(0).values.nan_to_num()
    return replace(log, z=torch.where(hit, log.z + sign * size * spread, log.z))


def correlated(filter: Recipe, log: Log, level: float, seed: int) -> Log:
    """White errors e replaced by c_k = r c_{k-1} + sqrt(1 - r^2) e_k, of the same variance."""
    log = log.only(filter.channels)
    errors = unstruck(filter, log)
    known = torch.isfinite(errors)
    sigma = torch.where(known, errors, 0.0).square().sum(0) / known.sum(0).clamp_min(1)
    draw = torch.randn(errors.shape, generator=stream(seed, "correlated"), dtype=errors.dtype)
    white = torch.where(known, errors, sigma.sqrt() * draw)
    kept, fresh = level, math.sqrt(1.0 - level * level)
    rows = [white[0]]
    for row in white[1:]:
        rows.append(kept * rows[-1] + fresh * row)
    change = torch.where(known, torch.stack(rows) - errors, 0.0)
    return replace(log, z=log.z + change)


def losing_channels(filter: Recipe, log: Log, level: float, seed: int) -> Log:
    """One channel missing at any time, another in each third; of one channel the middle third."""
    log = log.only(filter.channels)
    count = len(log.channels)
    third = (3 * torch.arange(log.steps)) // max(log.steps, 1)
    if count == 1:
        gone = (third == 1).reshape(-1, *[1] * (log.z.dim() - 1)).expand(log.z.shape)
    else:
        run = torch.arange(log.trajectories) if log.z.dim() > 2 else torch.zeros(1)
        lost = (third[:, None] + run[None]).long() % count
        gone = torch.nn.functional.one_hot(lost, count).bool().reshape(log.z.shape)
    return replace(log, z=torch.where(gone, torch.nan, log.z))


def sparser(filter: Recipe, log: Log, level: float, seed: int) -> Log:
    """Every second measurement of each channel missing."""
    log = log.only(filter.channels)
    odd = log.present.cumsum(0) % 2 == 1
    return replace(log, z=torch.where(odd, log.z, torch.nan))


def denser(filter: Recipe, log: Log, level: float, seed: int) -> Log:
    """A row between any two: the truth half-way, with the errors of another run or row."""
    log = log.only(filter.channels)
    assert log.truth is not None
    truth = _between(log)
    other = 1 if log.z.dim() > 2 and log.trajectories > 1 else 0

    def elsewhere(x: Tensor) -> Tensor:
        return x[1:].roll(1, 1) if other else x[1:].flip(0)

    errors = elsewhere(measurement_errors(filter, log))
    inputs = {
        name: elsewhere(x) if name in PER_CHANNEL else 0.5 * (x[1:] + x[:-1])
        for name, x in log.inputs.items()
    }
    time = 0.5 * (log.time[1:] + log.time[:-1])
    blank = torch.full_like(errors, torch.nan)
    middle = replace(log, time=time, z=blank, truth=truth, inputs=inputs, start=None)
    middle = replace(middle, z=_predicted(filter, middle) + errors)

    def woven(a: Tensor, b: Tensor) -> Tensor:
        pairs = torch.stack([a[:-1], b], 1).flatten(0, 1)
        return torch.cat([pairs, a[-1:]])

    return replace(
        log, time=woven(log.time, time), z=woven(log.z, middle.z), truth=woven(log.truth, truth),
        inputs={name: woven(log.inputs[name], x) for name, x in inputs.items()},
    )  # fmt: skip


def moved_start(filter: Recipe, log: Log, level: float, seed: int) -> Log:
    """The started log, its start off by ``level`` sigmas in each state, either way."""
    start = log.start
    assert start is not None
    begin = start_belief(filter, filter.prepare(), start)
    whole = start.mean.shape[-1] == len(filter.states)
    motion = filter.motion if whole else filter.bare_motion
    sigma = begin.covariance.diagonal(dim1=-2, dim2=-1).sqrt()[..., : len(motion.tangent)]
    draw = torch.rand(sigma.shape, generator=stream(seed, "start"), dtype=sigma.dtype)
    shift = level * torch.where(draw < 0.5, -sigma, sigma)
    mean = motion.retract(start.mean, shift)
    return replace(log, start=Start(mean, start.covariance, start.time))


def sustained(filter: Recipe, log: Log) -> float:
    """m/s^2, RMS of the truth's accelerations over ``ROWS`` rows; of one that never has any,
    what the published process noise allows in one row."""
    states = true_states(filter, log)
    velocity = states[..., _places(filter, "v")]
    time = _time(log)
    rows = min(ROWS, max(log.steps // 3, 1))
    push = (velocity[rows:] - velocity[:-rows]) / (time[rows:] - time[:-rows]).unsqueeze(-1)
    size = push.square().sum(-1)
    level = math.sqrt(float(size[torch.isfinite(size)].mean()))
    dt = float((time[1:] - time[:-1]).median())
    mean, inputs = states[0], {name: x[0] for name, x in log.inputs.items()}
    step = torch.tensor(dt, dtype=mean.dtype)
    noise = filter.bare_motion.noise(mean.nan_to_num(), step, inputs, filter.prepare())
    allowed = noise[..., _places(filter, "v"), :].square().sum((-1, -2)).mean().sqrt() / dt
    return level if level > 0.01 * float(allowed) else float(allowed)


def pushed(filter: Recipe, log: Log, size: float, across: bool) -> Log:
    """The truth with an acceleration of ``size`` along or across the path: + - - + in turn.

    Each lasts ``ROWS`` rows: after four the path is where it was. Errors stay as they are.
    """
    log = log.only(filter.channels)
    time = _time(log)
    ahead = _heading(filter, log)
    way = _across(ahead) if across else ahead
    rows = min(ROWS, max(log.steps // 4, 1))
    sign = torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=time.dtype)
    at = (torch.arange(log.steps) // rows) % 4
    push = size * sign[at].reshape(-1, *[1] * (way.dim() - 1)) * way
    dt = torch.diff(time, dim=0, prepend=time[:1]).unsqueeze(-1)
    velocity = (push * dt).cumsum(0)
    before = torch.cat([torch.zeros_like(velocity[:1]), velocity[:-1]])
    return _displaced(filter, log, (before * dt + 0.5 * push * dt.square()).cumsum(0), velocity)


def turned(filter: Recipe, log: Log, rate: float) -> Log:
    """The truth weaving at ``rate`` rad/s, up to 60 degrees to either side; two axes or more."""
    log = log.only(filter.channels)
    time = _time(log)
    states = true_states(filter, log)
    velocity = states[..., _places(filter, "v")]
    most = math.pi / 3.0
    phase = (rate * (time - time[:1])) % (4.0 * most)
    back = torch.where(phase < 3.0 * most, 2.0 * most - phase, phase - 4.0 * most)
    angle = torch.where(phase < most, phase, back).unsqueeze(-1)
    x, y = velocity[..., :1], velocity[..., 1:2]
    shift = torch.zeros_like(velocity)
    shift[..., :1] = angle.cos() * x - angle.sin() * y - x
    shift[..., 1:2] = angle.sin() * x + angle.cos() * y - y
    dt = torch.diff(time, dim=0, prepend=time[:1]).unsqueeze(-1)
    before = torch.cat([shift[:1], shift[:-1]])
    return _displaced(filter, log, (0.5 * (before + shift) * dt).cumsum(0), shift)


def _displaced(filter: Recipe, log: Log, position: Tensor, velocity: Tensor) -> Log:
    """The log of a truth moved by these, (T, ..., axes) each, with the errors it had."""
    assert log.truth is not None
    truth = log.truth.clone()
    for shift, prefix in ((position, ""), (velocity, "v")):
        for at, axis in enumerate(_axes(filter)):
            if f"{prefix}{axis}" in log.truth_states:
                truth[..., log.truth_states.index(f"{prefix}{axis}")] += shift[..., at]
    moved = replace(log, truth=truth)
    parts, at = [], 0
    old, new, constants = true_states(filter, log), true_states(filter, moved), filter.prepare()
    for sensor in filter.bare_sensors:
        a, b = (sensor.predict(x, log.inputs, constants) for x in (old, new))
        parts.append(log.z[..., at : at + len(sensor.channels)] + sensor.residual(b, a))
        at += len(sensor.channels)
    return replace(moved, z=torch.cat(parts, -1))


def _predicted(filter: Recipe, log: Log) -> Tensor:
    states, constants = true_states(filter, log), filter.prepare()
    return torch.cat([s.predict(states, log.inputs, constants) for s in filter.bare_sensors], -1)


def _between(log: Log) -> Tensor:
    """(T - 1, ...), the truth half-way between rows: constant acceleration where it tells."""
    assert log.truth is not None
    truth, time = log.truth, _time(log)
    middle = 0.5 * (truth[1:] + truth[:-1])
    dt = time[1:] - time[:-1]
    for axis in AXES:
        if axis in log.truth_states and f"v{axis}" in log.truth_states:
            speed = truth[..., log.truth_states.index(f"v{axis}")]
            middle[..., log.truth_states.index(axis)] -= 0.125 * dt * (speed[1:] - speed[:-1])
    return middle


def _time(log: Log) -> Tensor:
    """(T, ...) times, one for each trajectory."""
    time = log.time[(..., *[None] * (log.z.dim() - 1 - log.time.dim()))]
    return time.expand(log.z.shape[:-1])


def _axes(filter: Recipe) -> list[str]:
    return [name for name in filter.states if filter.kinds[name] == "position"]


def _places(filter: Recipe, prefix: str) -> list[int]:
    return [filter.states.index(f"{prefix}{axis}") for axis in _axes(filter)]


def _heading(filter: Recipe, log: Log) -> Tensor:
    """(T, ..., axes), unit vectors along the path; the first axis where it rests."""
    position = true_states(filter, log)[..., _places(filter, "")]
    k = torch.arange(log.steps)
    last = log.steps - 1
    way = position[(k + ROWS).clamp(max=last)] - position[(k - ROWS).clamp(min=0)]
    size = way.norm(dim=-1, keepdim=True)
    first = torch.zeros_like(way)
    first[..., 0] = 1.0
    return torch.where(size > 1e-6, way / size.clamp_min(1e-300), first)


def _across(ahead: Tensor) -> Tensor:
    """The horizontal normal of a unit vector."""
    side = torch.zeros_like(ahead)
    side[..., 0], side[..., 1] = -ahead[..., 1], ahead[..., 0]
    size: Tensor = side.norm(dim=-1, keepdim=True)
    return side / size.clamp_min(1e-12)
