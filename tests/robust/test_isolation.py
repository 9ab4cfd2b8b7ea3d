"""A federated filter leaves out a sensor that is not finite, names it, and takes it back."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cli_helpers import strict_json
from federated_cases import MOTION, P0, broken, line, log_of, position, without
from helpers import assert_close
from torch import Tensor

from difffilter.cli.main import main
from difffilter.comparison.optimality import fsp
from difffilter.errors import NonFiniteError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.robust.gate import Gate
from difffilter.running.batch import run
from difffilter.running.tracker import Tracker
from difffilter.scenario.scenario import load_scenario
from difffilter.scenario.simulation import simulate
from difffilter.scoring.metrics import isolated, rejected
from difffilter.weights.registry import huber, tanh

ROWS = [2, 3, 7]
NOT_FINITE = {"nan": torch.nan, "inf": torch.inf, "-inf": -torch.inf, "huge": 1e200}
OPTIONS: dict[str, dict[str, object]] = {
    "plain": {},
    "m-ekf": {"weight": tanh, "iterations": 2},
    "gate": {"weight": huber, "gate": Gate("reject"), "scope": "sensor"},
}


def pair(rng: np.random.Generator, value: float, **options: object) -> tuple[Filter, Log]:
    """Position and a sensor that is ``value`` in some rows; every channel measured."""
    sensors = (position(1), broken("bad", value), position(2, 6.0))
    filter = Filter(MOTION, sensors, federated=True, start_sigma=P0, **options)  # type: ignore[arg-type]
    flags = torch.zeros(12, 1, 1).double()
    flags[ROWS] = 1.0
    sane = replace(filter, sensors=(position(1), position(3), position(2, 6.0)))
    log = log_of(sane, rng)
    z = torch.where(torch.isnan(log.z), log.truth[..., :2].repeat(1, 1, 3), log.z)  # type: ignore[index]
    return filter, replace(log, channels=filter.channels, z=z, inputs={"broken": flags})


def record_of(track: Track) -> Any:
    assert track.record is not None
    return track.record


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("kind", NOT_FINITE)
def test_a_sensor_that_is_not_finite_is_left_out_named_and_taken_back(
    rng: np.random.Generator, kind: str, options: str
) -> None:
    filter, log = pair(rng, NOT_FINITE[kind], **OPTIONS[options])
    track = run(filter, log)
    record = record_of(track)
    expected = torch.zeros_like(record.isolated)
    expected[ROWS, :, 2:4] = True
    assert torch.equal(record.isolated, expected)
    assert torch.equal(record.present, ~expected)
    assert not record.weight[expected].any()
    assert isolated(track) == {"bad_1": pytest.approx(0.25), "bad_2": pytest.approx(0.25)}
    # The same log with these channels missing there, and a sensor that never fails.
    sound = replace(log, inputs={"broken": torch.zeros(12, 1, 1).double()})
    reference = run(filter, without(sound, ("bad_1", "bad_2"), ROWS))
    assert torch.equal(track.mean, reference.mean)
    assert torch.equal(track.deviations, reference.deviations)
    assert bool(record.weight[4, :, 2:4].any())
    assert isolated(reference) == {}


def test_a_central_filter_says_where_it_is_not_finite(rng: np.random.Generator) -> None:
    filter, log = pair(rng, torch.nan)
    with pytest.raises(
        NonFiniteError, match="innovation is not finite: trajectory 0, step 2, chan"
    ):
        run(filter.centralised, log)


def test_a_sensor_is_isolated_in_its_own_trajectory_alone(rng: np.random.Generator) -> None:
    filter, log = pair(rng, torch.nan)
    flags = torch.zeros(12, 3, 1).double()
    flags[4, 1] = 1.0
    track = run(filter, replace(log, inputs={"broken": flags}))
    assert record_of(track).isolated.nonzero().tolist() == [[4, 1, 2], [4, 1, 3]]


def test_one_channel_that_is_not_finite_takes_its_sensor_with_it(rng: np.random.Generator) -> None:
    filter, log = pair(rng, 0.0)
    z = log.z.clone()
    z[5, 0, 3] = 1e200
    track = run(filter, replace(log, z=z, inputs={"broken": torch.zeros(12, 1, 1).double()}))
    assert record_of(track).isolated.nonzero().tolist() == [[5, 0, 2], [5, 0, 3]]


@pytest.mark.parametrize("wild", [1e200, -1e200, 1e160])
def test_a_wild_measurement_is_isolated_and_the_others_go_on(
    rng: np.random.Generator, wild: float
) -> None:
    made = line(rng, missing=0.0, steps=10)
    filter = replace(made.filter, adaptation=None)
    z = made.log.z.clone()
    z[4, 0] = wild
    track = run(filter, replace(made.log, z=z))
    reference = run(filter, without(made.log, ("p1_1",), [4]))
    assert_close(track.mean, reference.mean, 1e-13)
    assert isolated(track) == {"p1_1": pytest.approx(0.1)}


def test_with_every_sensor_isolated_it_coasts(rng: np.random.Generator) -> None:
    made = line(rng, missing=0.0, steps=10)
    filter = replace(made.filter, adaptation=None)
    z = made.log.z.clone()
    z[3:6] = 1e200
    track = run(filter, replace(made.log, z=z))
    assert bool(record_of(track).isolated[3:6].all())
    dt = float(made.log.time[5] - made.log.time[2])
    coasted = track.mean[2].clone()
    coasted[0] += dt * coasted[1]
    assert_close(track.mean[5], coasted, 1e-13)
    assert float(track.std[5, 0]) > float(track.std[2, 0])
    nothing = run(filter, without(made.log, made.log.channels, [3, 4, 5]))
    assert torch.equal(track.mean, nothing.mean)


def test_an_isolated_system_keeps_its_credibility(rng: np.random.Generator) -> None:
    made = line(rng, missing=0.0, steps=12)
    z = made.log.z.clone()
    z[4:6, 0] = 1e200
    track = run(made.filter, replace(made.log, z=z))
    reference = run(made.filter, without(made.log, ("p1_1",), [4, 5]))
    assert_close(track.mean, reference.mean, 1e-13)
    assert track.final is not None
    assert reference.final is not None
    for name, memory in reference.final.memory.items():
        assert_close(track.final.memory[name], memory, 1e-13)


def test_the_tracker_isolates_what_the_batch_does(rng: np.random.Generator) -> None:
    made = line(rng, missing=0.0, steps=8)
    z = made.log.z.clone()
    z[3, 1] = -1e180
    batch = run(made.filter, replace(made.log, z=z))
    tracker = Tracker(made.filter, made.mean.tolist(), made.covariance.tolist())
    for k, dt in enumerate(made.log.intervals(0.0).tolist()):
        record = tracker.step(z[k], dt)
        assert record.isolated.tolist() == [False, k == 3]
        assert_close(tracker.belief.mean, batch.mean[k], 1e-12)


def test_a_gradient_is_finite_beside_an_isolated_measurement(rng: np.random.Generator) -> None:
    made = line(rng, steps=14)
    z = made.log.z.clone()
    z[3, 0], z[6] = 1e200, -1e200
    log = replace(made.log, z=z)
    values = {name: v.requires_grad_() for name, v in made.filter.published().items()}
    track = run(made.filter, log, values)
    total = (track.mean - log.truth).square().mean() + track.covariance.sum()  # type: ignore[operator]
    gradients: list[Tensor] = list(torch.autograd.grad(total, list(values.values())))
    assert all(bool(g.isfinite().all()) for g in gradients)
    sigma = list(values).index("p1.sigma")
    assert float(gradients[sigma].abs().sum()) > 0.0


def test_nothing_is_isolated_of_a_filter_without_local_ones(rng: np.random.Generator) -> None:
    made = line(rng)
    track = run(replace(made.filter.centralised, adaptation=None), made.log)
    assert not record_of(track).isolated.any()
    assert isolated(track) == {}
    assert isolated(replace(track, record=None)) == {}
    assert set(rejected(track)) == {"p1_1", "p2_1"}


def test_a_run_tells_which_channels_were_isolated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    short = ("--set", "world.steps=20")
    name = "urban-credibility"
    assert main(["simulate", name, *short, "--trajectories", "1", "--out", "log.csv"]) == 0
    lines = [text.split(",") for text in Path("log.csv").read_text().splitlines()]
    at = lines[0].index("position_2")
    for row in (5, 6):
        lines[row][at] = "1e200"
    Path("log.csv").write_text("\n".join(map(",".join, lines)) + "\n")
    capsys.readouterr()
    command = ["run", name, "log.csv", *short, "--out", "out.csv", "--system", "standard"]
    assert main([*command, "--json"]) == 0
    result = strict_json(capsys.readouterr().out)
    assert result["isolated"] == {"position_2": pytest.approx(0.1)}
    assert result["rmse"] < 10.0
    assert main(command) == 0
    assert "position_2 isolated as not finite in 10.0 % of rows" in capsys.readouterr().out


def test_the_fsp_function_isolates_too() -> None:
    """One wild measurement leaves the error of a federated system as it is."""
    scenario = load_scenario("urban-credibility", {"world.steps": 20, "scenes": []})
    log = simulate(scenario, 2, seed=3)
    z = log.z.clone()
    z[7, 0, 1] = 1e200
    wild = float(fsp(scenario, replace(log, z=z), "standard").delta)
    z[7, 0, 1] = torch.nan
    expected = float(fsp(scenario, replace(log, z=z), "standard").delta)
    assert wild == pytest.approx(expected, rel=1e-9)
