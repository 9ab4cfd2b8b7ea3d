"""What tuning refuses, and where it says that a gradient turned non-finite."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from tune_cases import FEW, airport, recorded

from difffilter.errors import InputError, NonFiniteError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.running.problem import Problem
from difffilter.scenario.scenario import load_scenario
from difffilter.scenario.simulation import simulate
from difffilter.sensors.builtin import Position
from difffilter.tuning.data import Batch
from difffilter.tuning.diagnose import gradient_error
from difffilter.tuning.loop import TuneResult, tune
from difffilter.weights.registry import WEIGHTS, Weight, huber


def tuned(**options: Any) -> TuneResult:
    settings = FEW | options.pop("settings", {})
    scenario = options.pop("scenario", None) or airport()
    return tune(scenario, settings=settings, **options)


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "baseline": ({"settings": {"system": "chan-ls"}}, "chan-ls is a baseline, expected a filter"),
    "system": ({"settings": {"system": "ukf"}}, "system: found 'ukf', expected one of taylor-ls"),
    "setting": ({"settings": {"step": 3}}, "tuning.step: unknown key, did you mean 'steps'"),
    "nothing tuned": (
        {"scenario": airport(**{
            f"parameters__{name}__tuned": False
            for name in ("tdoa__sigma", "tdoa__bias", "tanh__ab", "motion__acceleration")
        })},
        "tune: no parameter of m-ekf has tuned = true",
    ),
    "unknown loss": (
        {"settings": {"loss": {"rmse": 1.0}}},
        r"tuning\.loss\.rmse: found 1.0, expected a loss among position",
    ),
    "resume without out": ({"resume": True}, "resume: expected out"),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_tuned_is_an_input_error(name: str) -> None:
    options, message = WRONG[name]
    with pytest.raises(InputError, match=message):
        tuned(**options)


def test_a_loss_that_needs_truth_is_refused_without_it(tmp_path: Path) -> None:
    log = replace(recorded(tmp_path), truth=None, truth_states=())
    scenario = load_scenario("uwb-ranges")
    with pytest.raises(InputError, match="loss position: needs truth columns"):
        tune(scenario, log, settings={"steps": 1})
    settings = {"steps": 1, "loss": {"likelihood": 1.0}}
    result = tune(scenario, log, test=log, settings=settings)
    assert result.held_out is None
    assert result.checkpoint.result == {}


def test_one_log_without_a_dimension_of_trajectories_is_a_batch_of_one() -> None:
    scenario = airport()
    batch = simulate(scenario, 1, seed=8)
    assert batch.truth is not None
    assert batch.start is not None
    log = replace(
        batch, z=batch.z[:, 0], truth=batch.truth[:, 0], inputs={}, start=Start(batch.start.mean[0])
    )
    settings = FEW | {"steps": 1, "window": 5}
    single = tune(scenario, log, settings=settings).history
    batched = replace(batch, inputs={}, start=Start(batch.start.mean))
    assert repr(single) == repr(tune(scenario, [batched], settings=settings).history)


def _trap(limit: float) -> Weight:
    """Weight 1 everywhere; its gradient is infinite where a residual exceeds the limit."""

    def function(s: torch.Tensor, c: Values, temperature: torch.Tensor | None) -> torch.Tensor:
        sprung = s.abs() > limit
        step = torch.where(sprung, s - s.detach(), 1.0).sqrt()
        return torch.ones_like(s) + torch.where(sprung, step, 0.0)

    return Weight("huber", function, huber.parameters)


@pytest.mark.parametrize(("step", "trajectory", "channel"), [(3, 1, 2), (0, 0, 0), (5, 2, 1)])
def test_a_gradient_that_is_not_finite_is_located(step: int, trajectory: int, channel: int) -> None:
    from difffilter.motions.blocks import ConstantVelocity

    filter = Filter(ConstantVelocity(3), (Position(axes=3),), _trap(40.0), start_sigma=1.0)
    z = torch.zeros(6, 3, 3).double()
    z[step, trajectory, channel] = 500.0
    z[step + 1 :, trajectory] = torch.nan  # no other residual springs the trap
    log = Log(filter.channels, torch.arange(6).double(), z, torch.zeros_like(z), ("x", "y", "z"))
    batch = Batch(log, Start(torch.zeros(3, 6).double()))
    values = filter.published()
    assert run(filter, log, values, batch.start).mean.isfinite().all()
    error = gradient_error(Problem(filter, log, {"position": 1.0}, start=batch.start), values)
    assert (error.trajectory, error.step) == (trajectory, step)
    assert error.channel == filter.channels[channel]
    assert str(error).startswith("gradient is not finite: trajectory ")


def test_tuning_stops_at_a_gradient_that_is_not_finite() -> None:
    WEIGHTS.add("trap", _trap(15.0))
    keys = {"systems.ekf.weight": "trap", "systems.ekf.standardise": "noise"}
    scenario = airport(faults__nlos__channels=["tdoa_4"], faults__nlos__scale=400.0)
    try:
        scenario = scenario.with_overrides(keys)
        with pytest.raises(NonFiniteError, match="gradient is not finite") as caught:
            tuned(scenario=scenario, settings={"system": "ekf"})
    finally:
        WEIGHTS.remove("trap")
    assert caught.value.channel == "tdoa_4"
    assert 0 <= caught.value.step < 12
    assert 0 <= caught.value.trajectory < FEW["batch"]
