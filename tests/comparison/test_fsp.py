"""FSP function, optimal filtering ratio, FSP surface."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from helpers import array, assert_close, tensor

from difffilter.comparison.optimality import FSP, fsp, fsp_surface, ratio_gain
from difffilter.errors import InputError
from difffilter.logs.log import Log
from difffilter.scenario.estimation import estimate, started
from difffilter.scenario.scenario import Scenario, load_scenario
from difffilter.scenario.simulation import simulate

SCENES = [
    {"name": "start", "first": 1, "last": 12},
    {"name": "rest", "first": 20, "last": 40},
    {"name": "late", "first": 35, "last": 99},
]


@cache
def world() -> tuple[Scenario, Log]:
    scenario = load_scenario("urban-credibility", {"world.steps": 40, "scenes": SCENES})
    return scenario, simulate(scenario, 5, seed=2)


def errors(system: str, values: dict[str, torch.Tensor] | None = None) -> np.ndarray:
    """(T, B), squared errors of the position."""
    scenario, log = world()
    chosen = scenario.system(system)
    track = estimate(chosen, started(scenario, chosen, log), values)
    assert log.truth is not None
    return (array(track.mean[..., 0]) - array(log.truth[..., 0])) ** 2


@pytest.mark.parametrize("system", ["standard", "credibility", "ideal"])
def test_the_fsp_is_the_rmse_of_each_scene_over_time_and_runs(system: str) -> None:
    scenario, log = world()
    found = fsp(scenario, log, system)
    assert found.scenes == ("start", "rest", "late")
    squared = errors(system)
    parts = [squared[0:12], squared[19:40], squared[34:40]]
    assert_close(found.squared, np.stack([part.mean(0) for part in parts]), 1e-9)
    assert_close(found.delta, np.array([math.sqrt(part.mean()) for part in parts]), 1e-9)


def test_the_fsp_depends_on_the_values() -> None:
    scenario, log = world()
    values = {"motion.acceleration": tensor(4.0), "credibility.power": tensor(0.5)}
    found = fsp(scenario, log, "credibility", values).delta
    assert_close(found[0], np.sqrt(errors("credibility", values)[:12].mean()), 1e-9)
    assert not torch.allclose(found, fsp(scenario, log, "credibility").delta)
    assert_close(fsp(scenario, log).delta, fsp(scenario, log, "credibility").delta, 1e-15)


def test_without_scenes_it_is_that_of_all_rows() -> None:
    scenario, log = world()
    found = fsp(scenario.with_overrides({"scenes": []}), log, "standard")
    assert found.scenes == ("all",)
    assert float(found.delta) == pytest.approx(math.sqrt(errors("standard").mean()), rel=1e-9)


def test_only_scored_rows_count() -> None:
    scenario, log = world()
    scenario = scenario.with_overrides({"score_times": [0.2 * 3, 0.2 * 8]})
    with pytest.raises(InputError, match="scene rest: found a trajectory without a scored row"):
        fsp(scenario, log, "standard")
    found = fsp(scenario.with_overrides({"scenes": SCENES[:1]}), log, "standard")
    expected = math.sqrt(errors("standard")[2:8].mean())
    assert float(found.delta) == pytest.approx(expected, rel=1e-9)


def test_a_log_without_truth_has_no_fsp() -> None:
    scenario, log = world()
    with pytest.raises(InputError, match="truth: found none"):
        fsp(scenario, replace(log, truth=None, truth_states=()), "standard")


def test_the_ratio_is_psi_over_delta() -> None:
    scenario, log = world()
    own, ideal = fsp(scenario, log, "standard"), fsp(scenario, log, "ideal")
    assert_close(own.ratio(ideal), array(ideal.delta) / array(own.delta), 1e-15)
    assert_close(own.ratio(tensor([1.0, 2.0, 3.0])), [1.0, 2.0, 3.0] / array(own.delta), 1e-15)
    assert_close(own.ratio(own), np.ones(3), 1e-15)


def test_the_surface_holds_the_fsp_at_every_point_of_the_grid() -> None:
    scenario, log = world()
    grid = {"motion.acceleration": [0.3, 2.0], "credibility.kappa": [0.0, 5.0, 40.0]}
    rest = {"credibility.rate": tensor(0.3)}
    surface = fsp_surface(scenario, log, grid, "credibility", rest)
    assert surface.shape == (2, 3, 3)
    for i, q in enumerate(grid["motion.acceleration"]):
        for j, kappa in enumerate(grid["credibility.kappa"]):
            at = {"motion.acceleration": tensor(q), "credibility.kappa": tensor(kappa), **rest}
            assert_close(surface[i, j], fsp(scenario, log, "credibility", at).delta, 1e-13)


def test_an_entry_of_a_vector_is_a_direction_of_the_surface() -> None:
    scenario, log = world()
    surface = fsp_surface(scenario, log, {"start.sigma.vx": [0.1, 30.0]}, "standard")
    for i, sigma in enumerate((0.1, 30.0)):
        values = {"start.sigma": tensor([3.0, sigma])}
        assert_close(surface[i], fsp(scenario, log, "standard", values).delta, 1e-13)
    assert not torch.allclose(surface[0], surface[1])


def test_a_surface_needs_known_parameters_admissible_values_and_a_filter() -> None:
    scenario, log = world()
    with pytest.raises(InputError, match=r"credibility\.kapa: no such parameter, expected one of"):
        fsp_surface(scenario, log, {"credibility.kapa": [1.0]}, "credibility")
    with pytest.raises(InputError, match=r"motion\.acceleration: found -1"):
        fsp_surface(scenario, log, {"motion.acceleration": [-1.0]}, "credibility")
    airport = load_scenario("airport-mlat", {"world.steps": 3})
    with pytest.raises(InputError, match="fsp: found a baseline, expected a filter"):
        fsp_surface(airport, simulate(airport, 2), {"motion.acceleration": [1.0]}, "taylor-ls")


def made(*deltas: float, runs: int = 6) -> FSP:
    """The same error in every run."""
    return FSP(("a", "b"), tensor(np.square(deltas))[:, None].expand(2, runs))


def test_the_gain_of_the_mean_ratio_on_made_up_errors() -> None:
    """Ratios 1/2 and 1/4 against 1/4 and 1/8: twice as high."""
    found = ratio_gain(made(2.0, 4.0), made(4.0, 8.0), made(1.0, 1.0))
    assert found.gain == pytest.approx(1.0)
    assert found.ci95 == (pytest.approx(1.0), pytest.approx(1.0))
    assert found.per_scene == {"a": pytest.approx(-0.5), "b": pytest.approx(-0.5)}
    # A gain in one scene that is paid for in another: ratios 1/2, 1/8 against 1/4, 1/4.
    found = ratio_gain(made(2.0, 8.0), made(4.0, 4.0), made(1.0, 1.0))
    assert found.gain == pytest.approx(0.25)
    assert found.per_scene == {"a": pytest.approx(-0.5), "b": pytest.approx(1.0)}


def test_the_interval_is_paired_and_covers_the_gain(rng: np.random.Generator) -> None:
    common = rng.chisquare(1, (2, 300)) * np.array([[1.0], [9.0]])
    other = FSP(("a", "b"), tensor(common))
    mine = FSP(("a", "b"), tensor(common * rng.uniform(0.6, 0.7, (2, 300))))
    psi = FSP(("a", "b"), tensor(common * 0.3))
    found = ratio_gain(mine, other, psi)
    low, high = found.ci95
    assert low < found.gain < high
    assert found.gain == pytest.approx(1 / math.sqrt(0.65) - 1, abs=0.02)
    assert high - low < 0.01  # of independent samples it would be ten times as wide
    assert ratio_gain(mine, other, psi) == found
    assert ratio_gain(other, other, psi).ci95 == (0.0, 0.0)
