"""Windows of recorded logs: their warm starts are the whole run's beliefs, each row is met once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import assert_close, tensor
from tune_cases import ranges_log, recorded

from difffilter.core.beliefs import Belief
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start, stack_logs
from difffilter.running.batch import run
from difffilter.scenario.estimation import started
from difffilter.scenario.scenario import load_scenario
from difffilter.scoring.losses import LOSSES, LossContext
from difffilter.tuning.data import Windows

ROWS = 8
SCENARIO = load_scenario("uwb-ranges", {"systems.ekf.adaptation": "innovation-scaling"})


def system(name: str = "robust") -> Filter:
    made = SCENARIO.system(name)
    assert isinstance(made, Recipe)
    return made


def begun(log: Log, name: str = "robust") -> Start:
    start = started(SCENARIO, system(name), log).start
    assert start is not None
    return start


def windows(log: Log, name: str = "robust", rows: int = ROWS, every: int = 5) -> Windows:
    return Windows(log, begun(log, name), rows, every)


@pytest.mark.parametrize("name", ["robust", "ekf"])
def test_warm_starts_are_the_beliefs_of_the_whole_run(tmp_path: Path, name: str) -> None:
    log, filter = recorded(tmp_path), system(name)
    data = windows(log, name)
    values = filter.published() | {"range.sigma": tensor(0.3)}
    data.refresh(filter, values, 0)
    whole = run(filter, log, values, data.start)
    assert data.beliefs is not None
    for window in range(len(data.edges)):
        at = window * ROWS
        for b in range(log.trajectories):
            place = window * log.trajectories + b
            expected_mean = whole.mean[at - 1, b] if at else data.start.mean[b]
            assert_close(data.beliefs.mean[place], expected_mean, 1e-12)
            if at:
                found = data.beliefs.deviations[place]
                assert_close(found @ found.mT, whole.covariance[at - 1, b], 1e-11)
    memory = set(filter.start(data.start.mean, torch.eye(4).double()).memory)
    assert set(data.beliefs.memory) == memory
    assert bool(memory) == (name == "ekf")


@pytest.mark.parametrize("name", ["robust", "ekf"])
def test_windows_together_are_the_whole_run(tmp_path: Path, name: str) -> None:
    log, filter = recorded(tmp_path), system(name)
    data = windows(log, name)
    data.refresh(filter, filter.published(), 0)
    whole = run(filter, log, None, data.start)
    batch = data.batch(torch.arange(data.count))
    parts = run(filter, batch.log, None, batch.start)
    for column, place in enumerate(data.useful.tolist()):
        window, b = divmod(place, log.trajectories)
        rows = slice(window * ROWS, min((window + 1) * ROWS, log.steps))
        count = rows.stop - rows.start
        assert_close(parts.mean[1 : 1 + count, column], whole.mean[rows, b], 1e-11)


@pytest.mark.parametrize("rows", [2, 7, 8, 46, 47, 48, 500])
def test_every_row_is_in_one_window_and_no_other(tmp_path: Path, rows: int) -> None:
    log = recorded(tmp_path)
    data = windows(log, rows=rows)
    assert data.cut is not None
    assert log.truth is not None
    assert data.cut.truth is not None
    inside = data.cut.z[:, data.useful]
    assert int(data.cut.present.sum()) == int(log.present.sum())
    assert int((~inside.isnan()).sum()) == int(log.present.sum())
    for found, expected in ((data.cut.z, log.z), (data.cut.truth, log.truth)):
        kept = found[found.isfinite()]
        assert sorted(kept.tolist()) == sorted(expected[expected.isfinite()].tolist())
    assert not data.cut.present[0].any()  # row 0 carries the time alone
    assert data.cut.truth[0].isnan().all()


#: Those that recorded windows have: no scenes, no simulated worlds.
OVER_WINDOWS = [name for name in LOSSES if name not in ("scenes", "worlds")]


@pytest.mark.parametrize("name", OVER_WINDOWS)
def test_a_loss_over_all_windows_counts_each_row_once(tmp_path: Path, name: str) -> None:
    log, filter = recorded(tmp_path), system()
    data = windows(log)
    data.refresh(filter, filter.published(), 0)
    batch = data.batch(torch.arange(data.count))
    parts = run(filter, batch.log, None, batch.start)
    whole = run(filter, log, None, data.start)
    context = LossContext(score="measured")
    found = LOSSES[name](parts, batch.log, context)
    expected = LOSSES[name](whole, log, context)
    assert float(found) == pytest.approx(float(expected), rel=1e-9)


def test_warm_starts_are_renewed_when_it_is_time(tmp_path: Path) -> None:
    log, filter = recorded(tmp_path), system()
    data = windows(log, every=3)
    old = filter.published()
    new = old | {"range.sigma": tensor(1.0)}
    data.refresh(filter, old, 0)
    first = data.beliefs
    for step in (1, 2):
        data.refresh(filter, new, step)
        assert data.beliefs is first
    data.refresh(filter, new, 3)
    assert data.beliefs is not first
    assert isinstance(data.beliefs, Belief)
    assert isinstance(first, Belief)
    assert torch.equal(data.beliefs.mean[:2], first.mean[:2])  # the start itself
    assert not torch.equal(data.beliefs.mean[2:], first.mean[2:])


def test_warm_starts_hold_no_graph(tmp_path: Path) -> None:
    log, filter = recorded(tmp_path), system()
    data = windows(log)
    values = {name: value.requires_grad_() for name, value in filter.published().items()}
    data.refresh(filter, values, 0)
    assert data.beliefs is not None
    assert not data.beliefs.mean.requires_grad
    assert not data.beliefs.deviations.requires_grad


def test_stations_of_each_run_go_with_its_windows(tmp_path: Path) -> None:
    log = recorded(tmp_path)
    data = windows(log)
    data.refresh(system(), system().published(), 0)
    batch = data.batch(torch.arange(data.count))
    stations = batch.log.inputs["range.stations"]
    for column, place in enumerate(data.useful.tolist()):
        b = place % log.trajectories
        assert torch.equal(stations[:, column], log.inputs["range.stations"][:1, b].expand(9, 4, 3))


def test_windows_without_anything_to_learn_from_are_left_out() -> None:
    log = ranges_log("los_A1", 32, 0)
    z = log.z.clone()
    z[8:16] = torch.nan
    truth = log.truth.clone()  # type: ignore[union-attr]
    truth[24:] = torch.nan
    both = stack_logs([replace(log, z=z, truth=truth)])
    assert windows(both).useful.tolist() == [0, 2]
    bare = replace(both, truth=None, truth_states=())
    assert windows(bare).useful.tolist() == [0, 2, 3]
    empty = replace(both, z=torch.full_like(both.z, torch.nan))
    with pytest.raises(InputError, match="logs: found no row with a measurement"):
        Windows(empty, Start(torch.zeros(1, 4).double()), ROWS, 5)


def test_a_start_before_the_first_row_keeps_its_time(tmp_path: Path) -> None:
    log, filter = recorded(tmp_path), system()
    start = replace(begun(log), time=-2.0)
    data = Windows(log, start, ROWS, 5)
    data.refresh(filter, filter.published(), 0)
    batch = data.batch(torch.arange(2))
    parts = run(filter, batch.log, None, batch.start)
    whole = run(filter, log, None, start)
    assert_close(parts.mean[1:], whole.mean[:ROWS], 1e-11)


def test_kept_warm_starts_are_restored(tmp_path: Path) -> None:
    log, filter = recorded(tmp_path), system("ekf")
    data, other = windows(log, "ekf"), windows(log, "ekf")
    assert data.keep() == {}
    data.refresh(filter, filter.published(), 0)
    other.restore(data.keep())
    assert data.beliefs is not None
    assert other.beliefs is not None
    assert torch.equal(other.beliefs.mean, data.beliefs.mean)
    assert torch.equal(other.beliefs.deviations, data.beliefs.deviations)
    assert set(other.beliefs.memory) == set(data.beliefs.memory)
    for name, value in data.beliefs.memory.items():
        assert torch.equal(other.beliefs.memory[name], value)
