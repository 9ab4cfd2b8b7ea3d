"""Federated filters and logs that several tests share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from helpers import STATIONS, Array, tensor
from torch import Tensor

from difffilter.adaptation.credibility import Credibility
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.parameters.parameters import Values
from difffilter.sensors.builtin import TDOA, Position, Range
from difffilter.sensors.sensor import FunctionSensor, Inputs

MOTION = ConstantVelocity(2, acceleration=(2.0, 6.0))
P0 = (5.0, 4.0, 2.0, 3.0)
NEAR = STATIONS[:4]


def position(i: int, sigma: object = 3.0, axes: int = 2) -> Position:
    return Position(name=f"p{i}", axes=axes, sigma=sigma)  # type: ignore[arg-type]


#: Sensors of two, three and four systems, of several kinds.
SENSORS: dict[str, tuple[object, ...]] = {
    "two positions": (position(1), position(2, (5.0, 8.0))),
    "position and ranges": (position(1), Range(stations=NEAR, sigma=2.0, bias=0.5)),
    "common noise": (TDOA(stations=STATIONS, sigma=3.0, common_sigma=2.0), position(1)),
    "full R": (
        Range(name="r", stations=NEAR[:3], sigma=((4.0, 1.0, 0.5), (1.0, 3.0, 0.2), (0.5, 0.2, 2))),
        TDOA(stations=STATIONS, sigma=3.0),
        position(1),
    ),
    "four": (
        position(1),
        Range(stations=NEAR, sigma=2.0),
        position(2, 8.0),
        TDOA(name="t", stations=NEAR, sigma=4.0, common_sigma=1.0),
    ),
}


def federated(name: str, **options: object) -> Filter:
    return Filter(MOTION, SENSORS[name], federated=True, start_sigma=P0, **options)  # type: ignore[arg-type]


def random_shares(rng: np.random.Generator, count: int) -> tuple[float, ...]:
    """Positive, uneven by orders of magnitude, their sum 1."""
    raw = 10.0 ** rng.uniform(-2.0, 0.0, count)
    return tuple((raw / raw.sum()).tolist())


def log_of(filter: Filter, rng: np.random.Generator, steps: int = 12, runs: int = 3) -> Log:
    """Somebody drives on; noise, outliers, missing channels, sensors of different rates."""
    time = np.cumsum(rng.uniform(0.1, 0.4, steps))
    velocity = np.array([4.0, 12.0]) + rng.standard_normal((runs, 2))
    path = np.array([500.0, 700.0]) + time[:, None, None] * velocity
    truth = tensor(np.concatenate([path, np.broadcast_to(velocity, path.shape)], axis=-1))
    constants = filter.prepare()
    exact = torch.cat([sensor.predict(truth, {}, constants) for sensor in filter.sensors], dim=-1)
    noise = rng.standard_normal(exact.shape) * np.where(rng.random(exact.shape) < 0.1, 40.0, 3.0)
    z = exact + tensor(noise)
    z[tensor(rng.random(z.shape)) < 0.15] = torch.nan
    for i, own in enumerate(filter.members):  # sensor i at every (i + 1)th row
        silent = [k for k in range(steps) if (k + 1) % (i + 1)]
        z[torch.tensor(silent, dtype=torch.long)[:, None], :, torch.tensor([*own])] = torch.nan
    z[5:6] = torch.nan
    start = Start(truth[0] - tensor(rng.standard_normal((runs, 4))), None, 0.0)
    return Log(filter.channels, tensor(time), z, truth, ("x", "y", "vx", "vy"), {}, start)


def broken(name: str, value: float) -> FunctionSensor:
    """Position in two channels, times ``value`` where the log's input ``broken`` is 1."""

    def function(state: Tensor, inputs: Inputs, values: Values) -> Tensor:
        factor = torch.where(inputs["broken"] > 0.0, tensor(value), tensor(1.0))
        return factor * state[..., :2]

    return FunctionSensor((f"{name}_1", f"{name}_2"), function, 3.0, name=name)


@dataclass(frozen=True)
class Line:
    """Measurements of one trajectory for the oracle: position systems along ``axes`` axes."""

    filter: Filter
    log: Log
    dt: Array
    mean: Array
    covariance: Array


def line(
    rng: np.random.Generator,
    axes: int = 1,
    sigmas: tuple[object, ...] = (3.0, 5.0),
    steps: int = 40,
    missing: float = 0.15,
    ideal: bool = False,
    density: float = 0.85,
) -> Line:
    """A drive with a manoeuvre; system 1 measures three times as badly in the second half."""
    sensors = tuple(position(i, sigma, axes) for i, sigma in enumerate(sigmas, 1))
    systems = tuple(tuple(range(axes * i, axes * (i + 1))) for i in range(len(sigmas)))
    filter = Filter(
        ConstantVelocity(axes, "continuous", density),
        sensors,
        federated=True,
        adaptation=Credibility(systems, axes, ideal=ideal),
        start_sigma=(3.0,) * axes + (1.0,) * axes,
    )
    dt = rng.uniform(0.1, 0.3, steps)
    time = np.cumsum(dt)
    truth = np.zeros((steps, 2 * axes))
    truth[:, :axes] = 5.0 * time[:, None] + np.where(time > 3.0, (time - 3.0) ** 2, 0.0)[:, None]
    truth[:, axes:] = (5.0 + np.where(time > 3.0, 2.0 * (time - 3.0), 0.0))[:, None]
    scale = np.concatenate([np.broadcast_to(np.asarray(s, dtype=float), (axes,)) for s in sigmas])
    level = np.broadcast_to(scale, (steps, len(scale))).copy()
    level[steps // 2 :, :axes] *= 3.0
    error = level * rng.standard_normal(level.shape)
    z = np.tile(truth[:, :axes], len(sigmas)) + error
    z[rng.random(z.shape) < missing] = np.nan
    if missing:
        z[4], z[9, :axes], z[10, axes:] = np.nan, np.nan, np.nan
    levels = np.full(steps, np.nan)
    levels[10:20] = 3.0
    told = {"ideal.error": error, "ideal.variance": level**2, "ideal.process": levels}
    mean = truth[0] * 0.0 + rng.standard_normal(2 * axes)
    log = Log(
        filter.channels,
        tensor(time),
        tensor(z),
        tensor(truth),
        filter.states,
        {name: tensor(value) for name, value in told.items()},
        Start(tensor(mean), None, 0.0),
    )
    return Line(filter, log, dt, mean, np.diag([9.0] * axes + [1.0] * axes))


def without(log: Log, channels: tuple[str, ...], rows: list[int]) -> Log:
    """The log with these channels missing in these rows."""
    z = log.z.clone()
    index = torch.tensor([log.channels.index(name) for name in channels])
    for row in rows:
        z[row].index_fill_(-1, index, torch.nan)
    return replace(log, z=z)
