"""Benchmark: what a tuning pass costs, here and in JAX.

The job: value and gradient of the mean squared position error of a robust TDOA filter
(imq weights, 7 channels, 4 states) towards 3 parameters, float64. The JAX peers are the
same filter; losses and gradients must agree before anything is timed. Without JAX
(``pip install -e '.[bench]'``) torch is timed alone. Writes bench.json and bench.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from difffilter import Filter, Log, Start, run

Array = NDArray[np.float64]
Evaluate = Callable[[Array], tuple[float, Array]]

ROOT = Path(__file__).resolve().parent.parent
DT = 0.5
STATIONS = np.array(
    [
        (0, 0),
        (1600, 0),
        (0, 3500),
        (1600, 3500),
        (800, -400),
        (-500, 1700),
        (2100, 1900),
        (700, 4000),
    ],
    dtype=float,
)
VALUES = {"tdoa.sigma": 3.0, "motion.acceleration": 0.8, "imq.k": 3.0}
ROBUST = {"tdoa.sigma": 3.0, "motion.acceleration": 0.8, "tanh.ab": (1.5, 4.0)}
AGREEMENT = 1e-9


def problem(steps: int, batch: int) -> Log:
    """Random accelerations, seven range differences with 5 % gross errors, a start."""
    rng = np.random.default_rng(1)
    velocity = rng.normal(0, 8, (batch, 2)) + np.cumsum(
        0.5 * DT * rng.standard_normal((steps, batch, 2)), axis=0
    )
    position = rng.normal((800, 1500), 300, (batch, 2)) + DT * np.cumsum(velocity, axis=0)
    distance = np.linalg.norm(position[:, :, None] - STATIONS, axis=-1)
    z = distance[..., 1:] - distance[..., :1] + 3.0 * rng.standard_normal((steps, batch, 7))
    z += (rng.random(z.shape) < 0.05) * rng.normal(0, 60, z.shape)
    mean = np.concatenate([position[0], velocity[0]], axis=-1) + rng.normal(0, 5, (batch, 4))
    covariance = np.diag([50.0, 50.0, 25.0, 25.0])
    start = Start(torch.tensor(mean), torch.tensor(covariance))
    return Log(
        tuple(f"tdoa_{i}" for i in range(2, 9)),
        torch.tensor(DT * np.arange(1, steps + 1)),
        torch.tensor(z),
        torch.tensor(position),
        ("x", "y"),
        start=Start(start.mean, start.covariance, 0.0),
    )


def library(recipe: Filter, log: Log, names: tuple[str, ...]) -> Callable[..., tuple[float, Array]]:
    """Loss and gradient by this library; values in the order of ``names``, flattened."""

    def evaluate(values: Mapping[str, Any]) -> tuple[float, Array]:
        free = {
            name: torch.tensor(values[name], dtype=torch.float64).requires_grad_() for name in names
        }
        track = run(recipe, log, free, temperature=0.3)
        assert log.truth is not None
        loss = (track.mean[..., :2] - log.truth).square().sum(-1).mean()
        gradient = torch.autograd.grad(loss, list(free.values()))
        return loss.item(), torch.cat([g.reshape(-1) for g in gradient]).numpy()

    return evaluate
