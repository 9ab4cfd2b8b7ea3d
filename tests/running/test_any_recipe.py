"""Running, replaying, tuning's sums and tracking take a recipe that is no filter of the library."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import torch
from torch import Tensor

from difffilter import Belief, Log, Measurement, Record, Start, Tracker, run
from difffilter.engine.build import compiler
from difffilter.filters.recipe import Recipe
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter, check_values, declare
from difffilter.parameters.values import Constants, Values
from difffilter.running.objectives import Problem, objective

D = torch.float64


class Smoother(Recipe):
    """A level that follows its measurement: an alpha filter with a variance of its own."""

    @property
    def states(self) -> tuple[str, ...]:
        return ("x",)

    @property
    def channels(self) -> tuple[str, ...]:
        return ("z",)

    @property
    def declarations(self) -> dict[str, Parameter]:
        return declare([Parameter("rate", 0.5, Positive(), "1/s", tuned=True)])

    def with_values(self, values: Values) -> Smoother:
        return self

    def prepare(self, values: Values | None = None, temperature: float | None = None) -> Constants:
        return Constants(self.published() | check_values(self.declarations, values))

    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        return None

    def start(self, mean: Tensor, deviations: Tensor) -> Belief:
        return Belief(mean, deviations, {"seen": torch.zeros_like(mean)})

    def step(
        self, constants: Constants, belief: Belief, measurement: Measurement
    ) -> tuple[Belief, Record]:
        present = ~torch.isnan(measurement.z)
        share = 1.0 - torch.exp(-constants["rate"] * measurement.dt.unsqueeze(-1))
        innovation = torch.where(present, measurement.z - belief.mean, 0.0)
        ones = present.to(belief.mean.dtype)
        memory = {"seen": belief.memory["seen"] + ones}
        record = Record(
            innovation, belief.deviations, ones, innovation, ones, torch.ones_like(belief.mean),
            ones, ones[..., :0], present, ~present & False,
        )  # fmt: skip
        return Belief(belief.mean + share * innovation, belief.deviations, memory), record


TIME = np.array([0.0, 0.5, 1.5, 1.6, 3.0])
Z = np.array([1.0, 2.0, np.nan, -1.0, 0.5])


def log() -> Log:
    start = Start(torch.zeros(1, dtype=D), torch.eye(1, dtype=D), 0.0)
    z, time = torch.tensor(Z[:, None]), torch.tensor(TIME)
    truth = torch.ones(5, 1, dtype=D)
    return Log(("z",), time, z, truth, ("x",), start=start)


def expected(rate: float) -> np.ndarray:
    level, made = 0.0, []
    for z, dt in zip(Z, np.diff(TIME, prepend=0.0), strict=True):
        level += 0.0 if np.isnan(z) else (1.0 - np.exp(-rate * dt)) * (z - level)
        made.append(level)
    return np.array(made)


ENGINES = ["torch", pytest.param("fused", marks=pytest.mark.skipif(not compiler(), reason="cc"))]


@pytest.mark.parametrize("engine", ENGINES)
def test_a_recipe_of_ones_own_runs_tracks_and_replays(engine: str) -> None:
    track = run(Smoother(), log(), {"rate": torch.tensor(0.8, dtype=D)}, engine=engine)
    np.testing.assert_allclose(track.mean[:, 0].numpy(), expected(0.8), rtol=1e-13, atol=1e-13)
    assert track.final is not None
    assert track.final.memory["seen"].item() == 4.0
    trackers = [Tracker(Smoother(), [0.0], [[1.0]], engine=engine) for _ in range(2)]
    steps = np.diff(TIME, prepend=0.0)
    for z, dt in zip(Z, steps, strict=True):
        trackers[0].step([z], dt)
    trackers[1].feed(torch.tensor(Z[:, None]), torch.tensor(steps))
    for tracker in trackers:
        np.testing.assert_allclose(tracker.belief.mean.numpy(), expected(0.5)[-1:], rtol=1e-13)
        assert tracker.belief.memory["seen"].tolist() == [4.0]


@pytest.mark.parametrize("engine", ENGINES)
def test_its_loss_has_the_right_gradient(engine: str) -> None:
    rate = torch.tensor(0.8, dtype=D, requires_grad=True)
    loss, _ = objective(
        Problem(Smoother(), log(), {"position": 1.0}, engine=engine), {"rate": rate}
    )
    (slope,) = torch.autograd.grad(loss, [rate])

    def at(value: float) -> float:
        return float(np.log(np.mean((expected(value) - 1.0) ** 2)))

    assert loss.item() == pytest.approx(at(0.8), rel=1e-9)
    assert slope.item() == pytest.approx((at(0.80001) - at(0.79999)) / 2e-5, rel=1e-6)
