"""The urban scenario: beside a reference, its variants, and what tuning sees."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from helpers import array, assert_close, tensor
from oracles import federated as oracle

from difffilter.comparison.optimality import FSP, fsp
from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.scenario.estimation import estimate, started
from difffilter.scenario.scenario import Scenario, load_scenario
from difffilter.scenario.settings import TuneSettings
from difffilter.scenario.simulation import simulate
from difffilter.scoring.metrics import position_error
from difffilter.tuning.loop import tune
from difffilter.tuning.task import Task

NAME = "urban-credibility"
RUNS = 20
#: FSP in m of a reference computed independently (200 runs), by scene.
REFERENCE = {
    "standard": (1.07, 3.04, 3.55, 1.13),
    "credibility": (1.06, 1.85, 2.68, 1.13),
    "ideal": (0.79, 1.20, 1.84, 0.78),
}
#: Of the paper, Table 1.
PAPER = {
    "standard": (1.133, 3.044, 3.621, 1.088),
    "credibility": (1.065, 1.844, 2.311, 1.028),
    "ideal": (0.857, 1.339, 1.562, 0.798),
}
FEW: dict[str, Any] = {
    "trajectories": 6, "validation": 5, "batch": 3, "steps": 3, "evaluate_every": 1,
    "learning_rate": 0.2, "loss": {"scenes": 1.0, "consistency": 0.1},
}  # fmt: skip
SHORT = {
    "world.steps": 30,
    "scenes": [{"name": "1", "first": 1, "last": 15}, {"name": "2", "first": 16, "last": 30}],
}


@cache
def full() -> tuple[Scenario, Log]:
    scenario = load_scenario(NAME)
    return scenario, simulate(scenario, RUNS, seed=1)


@cache
def found(system: str) -> FSP:
    return fsp(*full(), system)


@pytest.mark.parametrize("system", REFERENCE)
def test_every_cell_is_near_the_references_and_the_papers(system: str) -> None:
    delta = array(found(system).delta)
    assert np.abs(delta / REFERENCE[system] - 1.0).max() < 0.25
    assert np.abs(delta / PAPER[system] - 1.0).mean() < 0.15


def test_credibility_lies_between_the_fixed_and_the_ideal_filter() -> None:
    standard, own, ideal = (found(name).delta for name in REFERENCE)
    assert bool((ideal < own).all())
    assert bool((own[:3] < 1.02 * standard[:3]).all())
    assert bool((own[1:3] < 0.85 * standard[1:3]).all())
    ratio = {name: array(found(name).ratio(found("ideal"))) for name in REFERENCE}
    loss = {name: 1.0 - xi[1] / xi[0] for name, xi in ratio.items()}
    assert 0.3 < loss["standard"] < 0.65
    assert 0.0 < loss["credibility"] < 0.25


@pytest.mark.parametrize("system", REFERENCE)
@pytest.mark.parametrize("name", [NAME, "urban-credibility-2d"])
def test_a_trajectory_of_the_scenario_is_the_oracles(name: str, system: str) -> None:
    scenario = load_scenario(name)
    log = simulate(scenario, 2, seed=8)
    axes = scenario.axes
    rows = slice(240, 560)  # changes of the noise, the manoeuvre and the ideal process noise
    chosen = scenario.system(system)
    assert log.truth is not None
    start = array(log.truth[239, 0])
    part = log.rows(240, 560).select([0])
    part = replace(part, start=Start(tensor(start[None]), None, float(log.time[239])))
    track = estimate(chosen, part)
    told = None
    if system == "ideal":
        told = oracle.Told(*(array(log.inputs[f"ideal.{key}"])[rows, 0]
                             for key in ("error", "variance", "process")))  # fmt: skip
    variances = np.repeat([9.0, 25.0], axes)
    systems = [list(range(axes)), list(range(axes, 2 * axes))]
    covariance = np.diag([9.0] * axes + [1.0] * axes)
    z, dt = array(log.z)[rows, 0], np.full(320, 0.2)
    if system == "standard":
        mean, spread = standard(z, start, covariance, variances, axes)
    else:
        mean, spread, _ = oracle.credibility_run(
            z, dt, start, covariance, 0.85, variances, systems, axes, oracle.Mapping(), told
        )
    assert_close(track.mean[:, 0], mean, 1e-9)
    assert_close(track.covariance[:, 0], spread, 1e-8)


def standard(
    z: np.ndarray, mean: np.ndarray, covariance: np.ndarray, variances: np.ndarray, axes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Algorithm 1 in one Kalman filter."""
    transition = oracle.kinematics.transition(axes, 0.2)
    process = oracle.kinematics.continuous_noise(0.85**2 * np.eye(axes), 0.2)
    rows, means, covariances = np.eye(axes, 2 * axes), [], []
    for y in z:
        parts = [slice(0, axes), slice(axes, 2 * axes)]
        systems = [(rows, np.diag(variances[part]), y[part]) for part in parts]
        mean, covariance = oracle.central_step(mean, covariance, transition, process, systems)
        means.append(mean)
        covariances.append(covariance)
    return np.stack(means), np.stack(covariances)


def test_a_bad_third_system_is_shared_out_of_the_fusion() -> None:
    scenario = load_scenario("urban-credibility-faulty")
    log = simulate(scenario, 10, seed=3)
    delta = {
        name: float(fsp(scenario, log, name).delta[1])
        for name in ("standard", "credibility", "good", "clairvoyant")
    }
    assert delta["standard"] > 10.0
    assert delta["credibility"] < 0.3 * delta["standard"]
    assert delta["clairvoyant"] < delta["credibility"]
    assert delta["good"] < delta["credibility"]


@cache
def short() -> Scenario:
    return load_scenario(NAME, SHORT)


def test_a_federated_system_is_tuned_to_the_values_of_its_central_form() -> None:
    central = short().with_overrides({"systems.credibility.federated": False})
    a, b = (tune(s, seed=3, settings=FEW) for s in (short(), central))
    assert repr(a.history) == repr(b.history)  # repr: the first training loss is NaN
    first, *_, last = (entry.values for entry in a.history)
    moved = {name for name, value in last.items() if value != first[name]}
    assert "motion.acceleration" in moved
    assert {"credibility.floor", "credibility.kappa"} & moved


def test_shares_make_no_difference_to_tuning() -> None:
    uneven = short().with_overrides({"systems.credibility.shares": [0.9, 0.1]})
    a, b = (tune(s, seed=3, settings=FEW | {"steps": 1}) for s in (short(), uneven))
    assert repr(a.history) == repr(b.history)


def test_tuning_compares_with_the_published_filter_on_the_same_trajectories() -> None:
    scenario, filter = short(), short().system("credibility")
    assert isinstance(filter, Recipe)
    settings = TuneSettings(system="credibility", **FEW)
    task = Task(scenario, filter, settings, 3)
    log = simulate(scenario, 5, 3, "validation")
    squared = position_error(log, estimate(filter, started(scenario, filter, log)))
    assert_close(task.check.log.inputs["reference.squared"], squared, 1e-9)
    batch = task.data.batch(torch.tensor([4, 1])).log
    train = simulate(scenario, 6, 3, "train")
    own = position_error(train, estimate(filter, started(scenario, filter, train)))
    assert_close(batch.inputs["reference.squared"], own[:, [4, 1]], 1e-9)
    plain = replace(settings, loss={"position": 1.0})
    assert "reference.squared" not in Task(scenario, filter, plain, 3).check.log.inputs


def test_what_is_tuned_is_what_the_paper_names() -> None:
    filter = load_scenario(NAME).system("credibility")
    assert {name for name, p in filter.declarations.items() if p.tuned} == {
        "motion.acceleration", "position_1.sigma", "position_2.sigma",
        "credibility.rate", "credibility.power", "credibility.floor", "credibility.followed",
        "credibility.kappa", "credibility.drift_rate",
    }  # fmt: skip
    published = {name: p.value for name, p in filter.declarations.items()}
    assert published["motion.acceleration"] == 0.85
    assert (published["credibility.rate"], published["credibility.power"]) == (0.1, 1.0)
    assert [published[f"credibility.{n}"] for n in ("floor", "followed", "kappa")] == [0.0] * 3


def test_an_ideal_system_refuses_a_recorded_log() -> None:
    scenario, log = short(), simulate(short(), 2, seed=1)
    recorded = replace(log, inputs={})
    with pytest.raises(InputError, match=r"log: found no input ideal\.variance, expected what a"):
        estimate(scenario.system("ideal"), recorded)
    for name in ("standard", "credibility"):
        assert bool(estimate(scenario.system(name), recorded).mean.isfinite().all())


def test_credibility_refuses_noise_that_channels_share() -> None:
    """It shares out variances; a full R would be counted twice."""
    matrix = {"parameters.position_1.sigma.value": [[9.0, 0.0], [0.0, 9.0]]}
    with pytest.raises(InputError, match="adaptation: found noise common to channels of x_1"):
        load_scenario("urban-credibility-2d", matrix)
