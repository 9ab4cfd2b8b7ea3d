"""Searches without derivatives: they find minima, keep to budgets, and resume as they were."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from difffilter import InputError, load_scenario, tune
from difffilter.errors import NonFiniteError
from difffilter.parameters.constraints import Real
from difffilter.parameters.parameters import Parameter, ParameterSet
from difffilter.tuning.search import SEARCHES, Search, available

SMALL = {"trajectories": 6, "validation": 4, "test": 2, "batch": 6, "evaluate_every": 1}
SCENARIO = load_scenario("gate-lockout", {"world.steps": 30, "tuning.system": "gated"})
CENTRE = torch.tensor([0.7, -0.4, 0.2], dtype=torch.float64)


def bowl() -> ParameterSet:
    return ParameterSet({"x": Parameter("x", (0.0, 0.0, 0.0), Real(), tuned=True)})


class Bowl:
    """A quadratic of the current numbers, and how often it was asked."""

    def __init__(self, parameters: ParameterSet) -> None:
        self.parameters, self.asked = parameters, 0

    def __call__(self, temperature: float | None) -> tuple[Tensor, dict[str, Tensor]]:
        assert temperature is None  # the hard form
        assert not torch.is_grad_enabled()
        self.asked += 1
        loss = (self.parameters.values()["x"] - CENTRE).square().sum()
        return loss, {"bowl": loss}


def search(name: str, steps: int, seed: int = 0) -> tuple[Search, Bowl]:
    parameters = bowl()
    made, function = Search(name, parameters, seed), Bowl(parameters)
    for step in range(steps):
        made.step(step, function, never, False)
    return made, function


def never(*args: Any) -> Any:
    raise AssertionError("asked for derivatives")


@pytest.mark.parametrize(("name", "steps", "within"), [
    ("random", 60, 0.3), ("nelder-mead", 30, 1e-4), ("cma-es", 60, 1e-4),
])  # fmt: skip
def test_a_search_finds_the_bottom_of_a_bowl_and_stands_there(
    name: str, steps: int, within: float
) -> None:
    made, function = search(name, steps)
    found = function.parameters.values()["x"].detach()
    assert float((found - CENTRE).norm()) < within
    assert float((found - CENTRE).square().sum()) == pytest.approx(made.loss, abs=1e-15)


@pytest.mark.parametrize("name", SEARCHES)
def test_the_same_seed_searches_the_same_points(name: str) -> None:
    (first, _), (again, _) = search(name, 4), search(name, 4)
    assert list(first.known) == list(again.known)
    if name != "nelder-mead":  # draws nothing
        assert list(search(name, 4, seed=1)[0].known) != list(first.known)


@pytest.mark.parametrize("name", SEARCHES)
def test_a_resumed_search_goes_on_as_if_uninterrupted_and_asks_nothing_twice(name: str) -> None:
    whole, _ = search(name, 9)
    state = search(name, 5)[0].state()
    parameters = bowl()
    resumed, function = Search(name, parameters, 0), Bowl(parameters)
    resumed.restore(state)
    assert function.asked == 0
    for step in range(5, 9):
        resumed.step(step, function, never, False)
    assert list(resumed.known) == list(whole.known)
    assert function.asked == len(whole.known) - len(state["losses"])


@pytest.mark.parametrize("name", SEARCHES)
def test_where_the_filter_breaks_down_the_loss_is_infinite_and_the_search_goes_on(
    name: str,
) -> None:
    parameters = bowl()
    made, function = Search(name, parameters, 0), Bowl(parameters)
    odd = [0]

    def fragile(temperature: float | None) -> tuple[Tensor, dict[str, Tensor]]:
        odd[0] += 1
        if odd[0] % 5 == 2:
            raise NonFiniteError("mean", 0, 0, "x")
        loss, terms = function(temperature)
        return (loss * torch.nan, terms) if odd[0] % 5 == 4 else (loss, terms)

    for step in range(20):
        made.step(step, fragile, never, False)
    losses = np.array(list(made.known.values()))
    assert np.isinf(losses).sum() >= 2
    assert np.isfinite(made.loss)
    assert made.loss == losses.min()


@pytest.mark.parametrize("name", SEARCHES)
def test_tuning_by_a_search_keeps_to_the_budget_and_never_gets_worse(name: str) -> None:
    settings = {**SMALL, "optimiser": name, "steps": 100, "runs": 240.0}
    result = tune(SCENARIO, settings=settings)
    again = tune(SCENARIO, settings=settings)
    assert repr(result.history) == repr(again.history)
    runs = [entry.runs for entry in result.history]
    assert runs == sorted(runs)
    assert 240.0 <= runs[-1] <= 240.0 + 6 * 20  # at most a generation more
    assert all((r / 6.0).is_integer() for r in runs)  # a value costs each trajectory one run
    training = [entry.training for entry in result.history[1:]]
    assert training == sorted(training, reverse=True)  # the best point so far stands
    if name == "nelder-mead":  # the others may need more than forty points
        assert training[-1] < training[0]


def test_a_gradient_counts_one_run_and_one_for_each_derivative() -> None:
    numbers = sum(p.tensor().numel() for p in tuned_parameters())
    result = tune(SCENARIO, settings={**SMALL, "optimiser": "adam", "steps": 3})
    runs = [entry.runs for entry in result.history]
    assert runs == [6.0 * (1 + numbers) * step for step in range(4)]
    few = tune(
        SCENARIO,
        settings={**SMALL, "optimiser": "adam", "steps": 50, "runs": 6.0 * (1 + numbers) * 2},
    )
    assert few.history[-1].step == 2


def tuned_parameters() -> list[Parameter]:
    return [p for p in SCENARIO.system("gated").declarations.values() if p.tuned]


def test_the_strategy_wants_two_numbers() -> None:
    single = ParameterSet({"x": Parameter("x", 0.0, Real(), tuned=True)})
    with pytest.raises(InputError, match="found one number to tune, expected two or more"):
        Search("cma-es", single, 0)


@pytest.mark.parametrize(("name", "package"), [("nelder-mead", "scipy"), ("cma-es", "cma")])
def test_a_missing_package_is_told_with_how_to_get_it(
    name: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def gone(module: str) -> Any:
        raise ImportError(module)

    monkeypatch.setattr(importlib, "import_module", gone)
    assert not available(name)
    with pytest.raises(InputError, match=rf"no package {package}.*difffilter\[search\]"):
        Search(name, bowl(), 0)
