"""The recorded ultra-wideband ranges: they load, run, stream and are cut as the spec says."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers import assert_close

from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.running.batch import run, start_belief
from difffilter.running.tracker import Tracker
from difffilter.scenario.estimation import started
from difffilter.scenario.recorded import load_logs
from difffilter.scenario.scenario import load_scenario
from difffilter.scoring.metrics import rmse
from difffilter.tuning.data import Windows

DATA = Path(__file__).parents[3] / "shared" / "data" / "uwb_ranges"
RUNS = ("los_A1", "los_A2", "nlos_A1", "nlos_A2")
SCENARIO = load_scenario("uwb-ranges")

pytestmark = pytest.mark.skipif(
    not DATA.is_dir(), reason="the recorded ranges are not here: ../shared/data/uwb_ranges"
)


def robust() -> Filter:
    system = SCENARIO.system("robust")
    assert isinstance(system, Recipe)
    return system


def logs(*runs: str, rows: int = 300) -> Log:
    log = load_logs(SCENARIO, [DATA / f"{run}.csv" for run in runs])
    return started(SCENARIO, robust(), log.rows(0, rows))


def test_all_runs_stack_with_their_own_anchors_and_gaps() -> None:
    log = load_logs(SCENARIO, [DATA / f"{run}.csv" for run in RUNS])
    assert log.names == RUNS
    assert log.channels == SCENARIO.channels
    anchors: dict[str, list[list[float]]] = {run: [] for run in RUNS}
    for line in (DATA / "anchors.csv").read_text().splitlines()[1:]:
        run_name, _, *point = line.split(",")
        anchors[run_name].append([float(number) for number in point])
    for b, name in enumerate(RUNS):
        assert log.inputs["range.stations"][0, b].tolist() == anchors[name]
    assert log.truth is not None
    missing = ~log.present[log.truth.isfinite().all(-1)]
    assert 0.02 < float(missing.double().mean()) < 0.25


def test_the_published_filters_follow_every_run() -> None:
    log = logs(*RUNS)
    errors = {}
    for name in SCENARIO.systems:
        system = SCENARIO.system(name)
        assert isinstance(system, Recipe)
        errors[name] = float(rmse(log, run(system, log), "measured"))
    assert max(errors.values()) < 3.0


def test_streaming_a_recorded_log_is_the_batch_run() -> None:
    filter, log = robust(), logs("nlos_A2")
    assert log.start is not None
    expected = run(filter, log)
    first = start_belief(filter, filter.prepare(), log.start)
    tracker = Tracker(filter, log.start.mean[0], first.covariance[0])
    for row, dt in enumerate(log.intervals(log.start.time)[:, 0]):
        inputs = {name: value[row, 0] for name, value in log.inputs.items()}
        tracker.step(log.z[row, 0], dt, inputs)
        assert_close(tracker.belief.mean, expected.mean[row, 0], 1e-11)


def test_windows_of_recorded_logs_are_the_whole_run() -> None:
    filter, log = robust(), logs("los_A1", "nlos_A2", rows=230)
    start = log.start
    assert isinstance(start, Start)
    data = Windows(log, start, 50, 10)
    data.refresh(filter, filter.published(), 0)
    batch = data.batch(torch.arange(data.count))
    parts, whole = run(filter, batch.log, None, batch.start), run(filter, log)
    for column, place in enumerate(data.useful.tolist()):
        window, b = divmod(place, 2)
        rows = whole.mean[50 * window : 50 * window + 50, b]
        assert_close(parts.mean[1 : 1 + len(rows), column], rows, 1e-9)
