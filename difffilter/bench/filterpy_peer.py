"""The plain filter by filterpy's ExtendedKalmanFilter: a Python loop, one step at a time."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter

from difffilter.bench.job import DT, PLAIN, STATIONS, Array, Contender, Task

__all__ = ["contenders", "stream"]

NAME = "filterpy"


def contenders(task: Task) -> list[Contender]:
    """One trajectory after the other; no gradient."""
    if task.filter != PLAIN:
        return []

    def value() -> float:
        z, truth = task.log.z.numpy(), task.truth
        total = 0.0
        for b in range(z.shape[1]):
            step, state = stream(task, b)
            for t in range(len(z)):
                step(z[t, b])
                total += float(np.sum((state()[:2] - truth[t, b]) ** 2))
        return float(np.log(total / (z.shape[0] * z.shape[1])))

    return [Contender(NAME, value, None, lambda: None, (26_000, 0))]


def stream(task: Task, trajectory: int) -> tuple[Callable[[Array], None], Callable[[], Array]]:
    """A step with a row (predict, but for the first; update), and the current mean."""
    sigma, acceleration = task.point[:2]
    noise = np.concatenate([0.5 * DT**2 * np.eye(2), DT * np.eye(2)])
    filter = ExtendedKalmanFilter(dim_x=4, dim_z=7)
    filter.x, filter.P = task.mean[trajectory].copy(), task.covariance.copy()
    filter.F = np.eye(4) + DT * np.eye(4, k=2)
    filter.Q = acceleration**2 * noise @ noise.T
    filter.R = sigma**2 * np.eye(7)

    begun = False

    def step(row: Array) -> None:
        nonlocal begun
        if begun:
            filter.predict()
        begun = True
        filter.update(row, _jacobian, _differences)

    return step, lambda: np.asarray(filter.x)


def _differences(state: Array) -> Array:
    distance = np.sqrt(np.sum((state[:2] - STATIONS) ** 2, axis=1))
    return np.asarray(distance[1:] - distance[0])


def _jacobian(state: Array) -> Array:
    apart = state[:2] - STATIONS
    unit = apart / np.sqrt(np.sum(apart**2, axis=1))[:, None]
    return np.concatenate([unit[1:] - unit[:1], np.zeros((7, 2))], axis=1)
