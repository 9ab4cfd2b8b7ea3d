"""Scenes, filters and logs that the tests of cubature, adaptations and fusion share."""

from __future__ import annotations

from functools import cache

import numpy as np
import torch
from helpers import tensor
from torch import Tensor

import difffilter as df
from difffilter.adaptation import (
    Chain,
    InnovationMatching,
    MultipleFading,
    PredictionCorrection,
    StrongTracking,
)
from difffilter.filters.filter import Filter
from difffilter.filters.fusion import Fusion
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.parameters.parameters import Values
from difffilter.sensors.builtin import Position
from difffilter.weights.registry import Weight, huber, plain

SCENES = ("manoeuvre-fusion-1", "manoeuvre-fusion-2")
P0 = np.diag([50.0, 50.0, 10.0, 10.0])
SIGMA = tuple(np.sqrt(np.diag(P0)).tolist())
ADAPTATIONS = {
    "matching": lambda weight: InnovationMatching(),
    "correction": lambda weight: PredictionCorrection(2),
    "strong tracking": StrongTracking,
    "multiple fading": MultipleFading,
    "chain": lambda weight: Chain((InnovationMatching(), PredictionCorrection(2))),
}


@cache
def scene(name: str, runs: int = 2) -> tuple[df.Scenario, Log]:
    scenario = df.load_scenario(name)
    return scenario, df.simulate(scenario, runs, 5, "test")


def estimated(name: str, system: str, runs: int = 2) -> df.Track:
    """Track of a system over a whole scene."""
    scenario, log = scene(name, runs)
    chosen = scenario.system(system)
    with torch.no_grad():
        return df.estimate(chosen, df.started(scenario, chosen, log, None), None)


def measured(name: str, *sensors: str) -> tuple[np.ndarray, np.ndarray]:
    """z (T, B, 2 per sensor) and the initial mean (B, 4)."""
    _, log = scene(name)
    at = [log.channels.index(f"{axis}_{sensor}") for sensor in sensors for axis in "xy"]
    assert log.start is not None
    return log.z[..., at].numpy(), log.start.mean.numpy()


def position(name: str = "position", sigma: float = 7.0) -> Position:
    return Position(name=name, sigma=sigma, channels=(f"x_{name}", f"y_{name}"))


def make(
    adaptation: str | None = None, weight: Weight = plain, rule: str = "cubature", **options: object
) -> Filter:
    """One position sensor and noise of the states."""
    plug_in = None if adaptation is None else ADAPTATIONS[adaptation](weight)
    standardise = "noise" if weight is not plain else None
    options = {"standardise": standardise, "start_sigma": SIGMA} | options
    motion = ConstantVelocity(2, "state", 1.0)
    return Filter(  # type: ignore[arg-type]
        motion, (position(),), weight, adaptation=plug_in, linearise=rule, **options
    )


def fused(rule: str = "cubature", **options: object) -> Fusion:
    """The precise sensor and two coarse ones."""
    sensors = (position("r"), position("a1", 10.0), position("a2", 10.0))
    motion = ConstantVelocity(2, "state", 1.0)
    options = {"start_sigma": SIGMA} | options
    return Fusion(motion, sensors, linearise=rule, **options)  # type: ignore[arg-type]


def bent_log(filter: Filter, steps: int = 12, runs: int = 3, seed: int = 8) -> Log:
    """Straight on, then a turn of the velocity, noise, outliers in one row."""
    rng = np.random.default_rng(seed)
    velocity = np.tile([30.0, 20.0], (steps, runs, 1))
    velocity[steps // 2 :] += [-40.0, 25.0]
    path = np.cumsum(velocity, axis=0)
    count = len(filter.channels) // 2
    z = np.tile(path, (1, 1, count)) + 7.0 * rng.standard_normal((steps, runs, 2 * count))
    z[3] += 150.0
    truth = np.concatenate([path, velocity], axis=-1)
    mean = np.concatenate([np.zeros((runs, 2)), velocity[0]], axis=-1)
    return Log(
        filter.channels,
        torch.arange(1.0, steps + 1, dtype=torch.float64),
        tensor(z),
        tensor(truth),
        ("x", "y", "vx", "vy"),
        {},
        Start(tensor(mean), None, 0.0),
    )


def free_values(filter: Filter) -> tuple[list[str], list[Tensor]]:
    """Names and unconstrained leaves of every parameter."""
    declared = filter.declarations
    return list(declared), [
        p.constraint.free(p.tensor()).requires_grad_() for p in declared.values()
    ]


def physical(filter: Filter, free: tuple[Tensor, ...] | list[Tensor]) -> Values:
    declared = filter.declarations
    return {
        name: p.constraint.physical(u) for (name, p), u in zip(declared.items(), free, strict=True)
    }


WEIGHTS = {"plain": plain, "huber": huber}
