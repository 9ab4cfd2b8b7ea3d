"""The job that is timed: the loss of a robust TDOA filter over a batch, and its gradient."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from difffilter.core.beliefs import Belief
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.batch import start_belief
from difffilter.running.objectives import Problem, objective
from difffilter.sensors.builtin import TDOA
from difffilter.weights.registry import imq, tanh

__all__ = ["DT", "FUSED", "IMQ", "M_EKF", "PLAIN", "STATIONS", "TASKS", "TORCH"]
__all__ += ["Array", "Contender", "Task", "own", "problem", "task"]

Array = NDArray[np.float64]

DT = 0.5
STATIONS: Array = np.array(
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
IMQ, PLAIN, M_EKF = "EKF, imq weights", "EKF, no weights", "M-EKF, 5 iterations"
FUSED, TORCH = "difffilter, fused", "difffilter, torch"
#: What is tuned of each filter, and the values at which it is timed.
TASKS: Mapping[str, Mapping[str, object]] = {
    IMQ: {"tdoa.sigma": 3.0, "motion.acceleration": 0.8, "imq.k": 3.0},
    PLAIN: {"tdoa.sigma": 3.0, "motion.acceleration": 0.8},
    M_EKF: {"tdoa.sigma": 3.0, "motion.acceleration": 0.8, "tanh.ab": (1.5, 4.0)},
}


@dataclass(frozen=True)
class Task:
    """One filter, one batch.

    Attributes:
        filter: which of ``TASKS``.
        recipe, log: as for :func:`difffilter.run`; start: as a belief, prepared.
        values: of the tuned parameters.
    """

    filter: str
    recipe: Filter
    log: Log
    start: Belief
    values: Mapping[str, Tensor]

    @property
    def truth(self) -> Array:
        """(T, B, 2)."""
        assert self.log.truth is not None
        return self.log.truth.numpy()

    @property
    def mean(self) -> Array:
        """(B, 4), at the start."""
        return self.start.mean.numpy()

    @property
    def covariance(self) -> Array:
        """(4, 4), at the start."""
        assert self.log.start is not None
        assert self.log.start.covariance is not None
        return self.log.start.covariance.numpy()

    @property
    def point(self) -> Array:
        """The tuned numbers, one after the other."""
        return torch.cat([v.reshape(-1) for v in self.values.values()]).numpy()


@dataclass(frozen=True)
class Contender:
    """Somebody who does a task.

    Attributes:
        name: as printed.
        value: the loss; gradient: the loss and its derivative towards the tuned numbers,
            or None where it has none.
        warm: makes ready for ``gradient`` without the task's memory.
        most: steps times trajectories from which it would take minutes: value, gradient.
        longest: steps from which it would.
    """

    name: str
    value: Callable[[], float]
    gradient: Callable[[], tuple[float, Array]] | None
    warm: Callable[[], object]
    most: tuple[int, int]
    longest: int = 10**9

    def takes(self, kind: str, steps: int, batch: int) -> bool:
        """Whether it does a job of this size, ``value`` or ``gradient``, in reasonable time."""
        if kind == "gradient" and self.gradient is None:
            return False
        return steps <= self.longest and steps * batch <= self.most[kind == "gradient"]


def problem(steps: int, batch: int) -> Log:
    """Loops among the stations, range differences with 5 % gross errors, a start at the first."""
    rng = np.random.default_rng(1)
    time = DT * np.arange(1, steps + 1)[:, None, None]
    size = rng.uniform(200.0, 500.0, (batch, 2))
    rate = rng.uniform(0.01, 0.04, (batch, 2))
    angle = rate * time + rng.uniform(0.0, 2.0 * np.pi, (batch, 2))
    centre = rng.normal((800.0, 1500.0), 200.0, (batch, 2))
    position = centre + size * np.sin(angle)
    velocity = size * rate * np.cos(angle[0])
    distance = np.linalg.norm(position[:, :, None] - STATIONS, axis=-1)
    z = distance[..., 1:] - distance[..., :1] + 3.0 * rng.standard_normal((steps, batch, 7))
    z += (rng.random(z.shape) < 0.05) * rng.normal(0.0, 60.0, z.shape)
    mean = np.concatenate([position[0], velocity], axis=-1) + rng.normal(0.0, 5.0, (batch, 4))
    covariance = np.diag([50.0, 50.0, 25.0, 25.0])
    return Log(
        tuple(f"tdoa_{i}" for i in range(2, 9)),
        torch.tensor(time[:, 0, 0]),
        torch.tensor(z),
        torch.tensor(position),
        ("x", "y"),
        start=Start(torch.tensor(mean), torch.tensor(covariance), DT),
    )


def task(filter: str, log: Log) -> Task:
    """A filter's task on a log; intervals are DT from the second row, 0 at the first."""
    values = {n: torch.tensor(v, dtype=torch.float64) for n, v in TASKS[filter].items()}
    parts = (ConstantVelocity(2), (TDOA(stations=STATIONS.tolist()),))
    recipe = {
        IMQ: lambda: Filter(*parts, imq),
        PLAIN: lambda: Filter(*parts),
        M_EKF: lambda: Filter(*parts, tanh, iterations=5),
    }[filter]()
    assert log.start is not None
    start = start_belief(recipe, recipe.prepare(values), log.start)
    return Task(filter, recipe, log, start, values)


def own(task: Task, engine: str) -> Contender:
    """This library, by one of its engines."""

    def loss(task: Task, values: Mapping[str, Tensor]) -> Tensor:
        losses = {"position": 1.0}
        asked = Problem(task.recipe, task.log, losses, start=task.start, engine=engine)
        return objective(asked, values)[0]

    def value() -> float:
        with torch.no_grad():
            return loss(task, task.values).item()

    def gradient(task: Task) -> tuple[float, Array]:
        free = {name: value.clone().requires_grad_() for name, value in task.values.items()}
        found = loss(task, free)
        parts = torch.autograd.grad(found, list(free.values()))
        return found.item(), torch.cat([part.reshape(-1) for part in parts]).numpy()

    few = Belief(task.start.mean[:1], task.start.deviations[:1], task.start.memory)
    small = Task(task.filter, task.recipe, problem(2, 1), few, task.values)
    most = (10**9, 10**9)
    if engine == "torch":
        most = (100_000, 30_000) if task.filter == M_EKF else (500_000, 100_000)
    return Contender(
        FUSED if engine == "fused" else TORCH,
        value,
        partial(gradient, task),
        partial(gradient, small),
        most,
        longest=10**9 if engine == "fused" else 1000,
    )
