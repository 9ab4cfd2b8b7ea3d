"""Any state is scored under its own name: whoever made filter and log."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import array, assert_close, tensor
from torch import Tensor

import difffilter as df
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.function import FunctionMotion
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter
from difffilter.running.batch import run
from difffilter.running.objectives import Problem, objective
from difffilter.scenario.model import Model
from difffilter.scoring.differences import Score, scored_states, scored_unit, squared_error
from difffilter.scoring.losses import LOSSES
from difffilter.scoring.metrics import nees, rmse, state_rmse
from difffilter.sensors.sensor import FunctionSensor

STATES = ("east", "north", "heading", "drift")
KINDS = {"east": "position", "north": "position", "heading": "angle"}


def moved(state: Tensor, dt: Tensor, inputs: dict, constants: dict) -> Tensor:
    turned = state[..., 2] + 0.3 * dt
    return torch.stack([state[..., 0] + dt, state[..., 1], turned, state[..., 3]], -1)


def noise(dt: Tensor, constants: dict) -> Tensor:
    return torch.eye(4, dtype=dt.dtype) * constants["motion.level"] * dt.sqrt()[..., None, None]


def read(state: Tensor, inputs: dict, constants: dict) -> Tensor:
    east, north, heading, drift = state.unbind(-1)
    return torch.stack([east, north, heading.cos(), heading.sin(), drift], -1)


def own_filter(kinds: dict[str, str] = KINDS, level: float = 0.1) -> Filter:
    motion = FunctionMotion(
        STATES, moved, noise, (Parameter("motion.level", level, Positive(), tuned=True),),
        kinds=kinds,
    )  # fmt: skip
    return Filter(motion, (FunctionSensor(("e", "n", "cos", "sin", "d"), read, sigma=0.2),))


def own_log(rng: np.random.Generator, order: tuple[str, ...] = STATES, count: int = 3) -> Log:
    time = np.arange(1, 41) * 1.0
    truth = np.zeros((40, count, 4))
    truth[..., 0], truth[..., 1] = time[:, None], 5.0
    truth[..., 2] = np.mod(0.3 * time[:, None] + np.pi, 2 * np.pi) - np.pi
    truth[..., 3] = -0.7
    heading = truth[..., 2]
    z = np.stack(
        [truth[..., 0], truth[..., 1], np.cos(heading), np.sin(heading), truth[..., 3]], -1
    )
    z = z + 0.2 * rng.standard_normal(z.shape)
    start = Start(tensor([0.0, 5.0, 0.0, -0.7]), 0.01 * torch.eye(4).double(), 0.0)
    at = [STATES.index(name) for name in order]
    return Log(
        ("e", "n", "cos", "sin", "d"), tensor(time), tensor(z), truth=tensor(truth[..., at]),
        truth_states=order, start=start,
    )  # fmt: skip


def expected(log: Log, track: df.Track, name: str) -> np.ndarray:
    """Squared errors of one state; angles by the chord of the circle's arc, without wrap."""
    true = array(log.truth[..., log.truth_states.index(name)])
    found = array(track.mean[..., STATES.index(name)])
    if name == "heading":
        return np.angle(np.exp(1j * (found - true))) ** 2
    return (found - true) ** 2


@pytest.mark.parametrize("name", STATES)
def test_each_state_has_its_error_under_its_own_name(rng: np.random.Generator, name: str) -> None:
    log = own_log(rng, ("drift", "heading", "north", "east"))
    track = run(own_filter(), log)
    error = expected(log, track, name)
    assert_close(squared_error(log, track, Score(states=(name,))), error, 1e-12)
    rows = torch.ones(40, 3, dtype=torch.bool)
    assert_close(tensor(state_rmse(log, track, rows)[name]), np.sqrt(error.mean()), 1e-12)
    assert error.max() < 1.0  # the heading passes pi twice
    loss, _ = objective(Problem(own_filter(), log, {f"error-{name}": 1.0}), {})
    assert_close(loss, np.log(error.mean()), 1e-9)


def test_the_position_is_what_the_model_says_it_is(rng: np.random.Generator) -> None:
    log = own_log(rng)
    track = run(own_filter(), log)
    both = expected(log, track, "east") + expected(log, track, "north")
    assert scored_states(log, track) == ["east", "north"]
    assert scored_unit(log, track) == "m"
    assert_close(rmse(log, track), np.sqrt(both.mean()), 1e-12)
    angles = run(own_filter({"heading": "angle"}), log)
    assert scored_states(log, angles) == ["heading"]  # no position, no velocity
    assert scored_unit(log, angles) == "rad"


def test_the_nees_of_an_angle_is_that_of_the_wrapped_error(rng: np.random.Generator) -> None:
    log = own_log(rng)
    turned = log.truth.clone()
    turned[..., 2] += 2.0 * torch.pi
    track = run(own_filter(), log)
    assert_close(nees(replace(log, truth=turned), track), nees(log, track), 1e-9)


@pytest.mark.parametrize("engine", ["torch", "fused"])
def test_a_loss_of_a_state_has_the_gradient_of_differences(
    rng: np.random.Generator, engine: str
) -> None:
    log, filter = own_log(rng), own_filter()

    def value(level: float) -> Tensor:
        given = {"motion.level": tensor(level).requires_grad_()}
        loss, _ = objective(
            Problem(filter, log, {"error-heading": 1.0, "error-drift": 0.5}, engine=engine), given
        )
        (gradient,) = torch.autograd.grad(loss, list(given.values()))
        return torch.stack([loss.detach(), gradient])

    low, here, high = (value(level) for level in (0.1 - 1e-5, 0.1, 0.1 + 1e-5))
    assert_close(here[1], array((high[0] - low[0]) / 2e-5), 1e-6)


def test_names_that_are_no_state_are_refused(rng: np.random.Generator) -> None:
    log, filter = own_log(rng), own_filter()
    track = run(filter, log)
    with pytest.raises(InputError, match="state: found 'speed', expected among east, north"):
        squared_error(log, track, Score(states=("speed",)))
    with pytest.raises(InputError, match="error-STATE"):
        _ = LOSSES["error"]
    with pytest.raises(InputError, match="found 'speed'"):
        objective(Problem(filter, log, {"error-speed": 1.0}), {})
    fewer = own_log(rng, ("drift",))
    with pytest.raises(InputError, match="expected truth_east and truth_north"):
        rmse(fewer, run(filter, fewer))
    assert float(rmse(fewer, run(filter, fewer), Score(states=("drift",)))) < 0.2


def test_comparison_and_tuning_score_the_states_that_were_chosen(rng: np.random.Generator) -> None:
    model = Model(own_filter(level=2.0), score=Score(states=("heading",)))
    log = own_log(rng)
    found = df.compare(model, log=log)
    (row,) = found.rows
    error = expected(log, run(model.recipe, log), "heading")
    assert row.rmse == pytest.approx(float(np.sqrt(error.mean())), rel=1e-9)
    assert row.per_state["heading"] == pytest.approx(row.rmse, rel=1e-9)
    assert list(row.per_state) == list(STATES)
    assert "RMSE (rad)" in found.markdown()
    assert "| system | values | east | north | heading | drift |" in found.states_markdown()
    settings = {"steps": 8, "learning_rate": 0.3, "loss": {"error-drift": 1.0}}
    tuned = df.tune(model, log, validation=log, test=log, settings=settings)
    before = found.rows[0].per_state["drift"]
    assert tuned.held_out.row(model.name, "tuned").per_state["drift"] < before
