"""Filters and logs that the tests of runs, trackers and gradients share."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from helpers import STATIONS, tensor
from oracles import airport
from torch import Tensor

from difffilter.adaptation import InnovationScaling
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.robust.gate import Gate
from difffilter.sensors.builtin import TDOA
from difffilter.sensors.sensor import Inputs
from difffilter.weights.registry import huber, igg3, imq, tanh

SIGMA = 3.0
MOTION = ConstantVelocity(2, acceleration=(2.0, 6.0))
P0 = (5.0, 4.0, 2.0, 3.0)
FULL = tuple(tuple(4.0 * (i == j) + 3.0 for j in range(7)) for i in range(7))


def tdoa(**options: object) -> TDOA:
    return TDOA(**({"stations": STATIONS, "sigma": SIGMA} | options))  # type: ignore[arg-type]


def make(sensor: TDOA | None = None, **options: object) -> Filter:
    return Filter(MOTION, (sensor or tdoa(),), start_sigma=P0, **options)  # type: ignore[arg-type]


@dataclass(frozen=True)
class Shifted(TDOA):
    """A sensor that reads a known offset (..., 1) from the log's input ``offset``."""

    def measure(self, position: Tensor, inputs: Inputs, constants: object) -> tuple[Tensor, Tensor]:
        h, gradient = super().measure(position, inputs, constants)  # type: ignore[arg-type]
        return h + inputs["offset"], gradient


FILTERS: dict[str, Filter] = {
    "ekf": make(),
    "m-ekf": make(weight=tanh, iterations=3),
    "all rows": make(weight=huber, iterations=3, weigh_prior=True),
    "mad": make(weight=tanh, iterations=2, weigh_prior=True, mad=True),
    "imq": make(weight=imq),
    "igg3": make(weight=igg3, standardise="noise"),
    "gate": make(gate=Gate("reject")),
    "gate reweigh": make(weight=igg3, gate=Gate("reweigh")),
    "gate inflate": make(gate=Gate("inflate")),
    "adaptive": make(adaptation=InnovationScaling(window=4)),
    "full R": make(tdoa(sigma=FULL), weight=tanh, iterations=2),
    "common noise": make(tdoa(common_sigma=2.0), weight=imq),
    "bias per channel": make(tdoa(bias=tuple(0.5 * i for i in range(7)))),
}
SHIFTED = make(Shifted(stations=STATIONS, sigma=SIGMA), weight=tanh, iterations=2)


def airport_log(
    steps: int = 20, runs: int = 3, missing: float = 0.15, seed: int = 4, nlos: float = 60.0
) -> Log:
    """NLOS now and then, channels missing at random, row 5 wholly, intervals that vary."""
    rng = np.random.default_rng(seed)
    data = airport.simulate(rng, runs, steps, n_l_ns=nlos, p=0.15)
    z = np.swapaxes(data["measurements"][:, 1:], 0, 1).copy()
    z[rng.random(z.shape) < missing] = np.nan
    if missing:
        z[5] = np.nan
    time = np.cumsum(rng.uniform(0.05, 0.15, steps))
    time[6] = time[5]
    truth = np.swapaxes(data["truth"][:, 1:], 0, 1)
    names = ("x", "y", "vx", "vy")
    start = Start(tensor(data["initial_mean"]), None, 0.0)
    return Log(tdoa().channels, tensor(time), tensor(z), tensor(truth), names, {}, start)


def with_offset(log: Log) -> Log:
    """The same log with an offset of its own in every row and trajectory."""
    offset = 4.0 * torch.sin(torch.arange(log.z[..., 0].numel()).double())
    offset = offset.reshape(log.z.shape[:-1]).unsqueeze(-1)
    return replace(log, z=log.z + offset, inputs={"offset": offset})
