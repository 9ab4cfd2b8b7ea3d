"""The time loop: batches, missing rows, intervals, inputs, starts, errors."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers import STATIONS, array, assert_close, tensor
from oracles import airport, kinematics, textbook
from run_cases import FILTERS, P0, SHIFTED, airport_log, make, tdoa, with_offset

from difffilter.core.beliefs import Belief
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.running.batch import run, start_belief

LOG = airport_log()


def first(log: Log, index: int) -> Log:
    """One trajectory without the dimension of trajectories."""
    assert log.start is not None
    start = Start(log.start.mean[index], None, log.start.time)
    assert log.truth is not None
    inputs = {name: value[:, index] for name, value in log.inputs.items()}
    return replace(log, z=log.z[:, index], truth=log.truth[:, index], inputs=inputs, start=start)


@pytest.mark.parametrize("name", FILTERS)
def test_a_batch_is_its_trajectories_run_one_by_one(name: str) -> None:
    track = run(FILTERS[name], LOG)
    assert track.record is not None
    assert track.final is not None
    for i in range(LOG.trajectories):
        single = run(FILTERS[name], first(LOG, i))
        assert single.record is not None
        assert_close(single.mean, track.mean[:, i], 1e-12)
        assert_close(single.covariance, track.covariance[:, i], 1e-10)
        assert_close(single.record.weight, track.record.weight[:, i], 1e-9)
        assert_close(single.record.nis, track.record.nis[:, i], 1e-9)


def test_the_final_belief_continues_the_run() -> None:
    filter, half = FILTERS["adaptive"], 11
    whole = run(filter, LOG)
    before = run(filter, LOG.rows(0, half))
    assert before.final is not None
    blank = LOG.z[half - 1 : half] * torch.nan  # carries the time of the belief
    rest = LOG.rows(half - 1, LOG.steps)
    rest = replace(rest, z=torch.cat([blank, rest.z[1:]]))
    after = run(filter, rest, start=before.final)
    assert_close(after.mean[1:], whole.mean[half:], 1e-13)
    assert_close(after.covariance[1:], whole.covariance[half:], 1e-12)


def test_variable_intervals_and_missing_rows_are_the_textbook_filter() -> None:
    log = first(LOG, 0)
    assert log.start is not None
    track = run(FILTERS["ekf"], log)
    mean, cov = array(log.start.mean), torch.diag(tensor(P0).square()).numpy()
    for k, dt in enumerate(log.intervals(0.0).tolist()):
        process = kinematics.discrete_noise(torch.diag(tensor([4.0, 36.0])).numpy(), dt)
        mean, cov = textbook.predict(mean, cov, kinematics.transition(2, dt), process)
        seen = array(log.present[k])
        innovation, rows = textbook.linearise(mean, array(log.z[k]))
        noise = 9.0 * torch.eye(int(seen.sum())).double().numpy()
        mean, cov = textbook.kalman_update(mean, cov, innovation[seen], rows[seen], noise)
        assert_close(track.mean[k], mean, 1e-11)
        assert_close(track.covariance[k], cov, 1e-9)


def test_a_row_without_measurements_only_predicts() -> None:
    log = first(LOG, 0)
    track = run(FILTERS["m-ekf"], log)
    assert track.record is not None
    dt = float(log.time[5] - log.time[4])
    expected = kinematics.transition(2, dt) @ array(track.mean[4])
    assert_close(track.mean[5], expected, 1e-13)
    assert not track.record.weight[5].any()
    assert float(track.record.nis[5]) == 0.0


def test_times_of_each_trajectory_are_its_own() -> None:
    assert LOG.start is not None
    scale = torch.tensor([1.0, 0.5, 2.0], dtype=torch.float64)
    log = replace(LOG, time=LOG.time.unsqueeze(-1) * scale)
    track = run(FILTERS["m-ekf"], log)
    for i in range(3):
        single = replace(first(LOG, i), time=LOG.time * scale[i])
        assert_close(track.mean[:, i], run(FILTERS["m-ekf"], single).mean, 1e-12)


def test_inputs_arrive_row_by_row() -> None:
    filter = make(weight=SHIFTED.weight, iterations=2)
    expected = run(filter, LOG)
    found = run(SHIFTED, with_offset(LOG))
    assert_close(found.mean, expected.mean, 1e-12)
    other = replace(with_offset(LOG), inputs={"offset": torch.zeros(20, 3, 1).double()})
    assert float((run(SHIFTED, other).mean - expected.mean).abs().max()) > 0.1


def test_stations_can_move_from_row_to_row_and_differ_between_trajectories() -> None:
    moved = tensor(STATIONS) + 40.0 * torch.arange(60).double().reshape(20, 3, 1, 1)
    offset = moved[..., :1, :] - tensor(STATIONS)[:1]
    shifted = replace(LOG, inputs={"tdoa.stations": moved})
    track = run(FILTERS["ekf"], shifted)
    same = run(FILTERS["ekf"], replace(LOG, inputs={"tdoa.stations": moved - offset}))
    assert_close(same.mean, run(FILTERS["ekf"], LOG).mean, 1e-13)
    assert float((track.mean - same.mean).abs().max()) > 1.0


def test_single_precision_runs_in_single_precision() -> None:
    log = LOG.to(torch.float32)
    for name in ("m-ekf", "mad", "gate", "full R", "adaptive"):
        track = run(FILTERS[name], log)
        assert track.record is not None
        for part in (track.mean, track.deviations, track.record.weight, track.record.nis):
            assert part.dtype == torch.float32
        assert_close(track.mean.double(), run(FILTERS[name], LOG).mean, 2e-4)


def test_a_start_is_the_logs_own_or_a_given_one_or_a_belief() -> None:
    assert LOG.start is not None
    filter = FILTERS["m-ekf"]
    expected = run(filter, LOG)
    covariance = torch.diag(tensor(P0).square())
    bare = replace(LOG, start=None)
    given = run(filter, bare, start=Start(LOG.start.mean, covariance, 0.0))
    at_zero = start_belief(filter, filter.prepare(), LOG.start)
    early = run(filter, replace(bare, time=LOG.time - LOG.time[0]), start=at_zero)
    assert_close(given.mean, expected.mean, 1e-13)
    assert not torch.equal(early.mean, expected.mean)  # a belief stands at the first row's time
    first_dt = run(filter, bare, start=replace(LOG.start, time=float(LOG.time[0])))
    assert_close(early.mean, first_dt.mean, 1e-13)


@pytest.mark.parametrize("name", ["m-ekf", "adaptive"])
def test_one_start_serves_every_trajectory(name: str) -> None:
    assert LOG.start is not None
    one = LOG.start.mean[0]
    single = run(FILTERS[name], LOG, start=Start(one, None, 0.0))
    every = run(FILTERS[name], LOG, start=Start(one.expand(3, 4), None, 0.0))
    assert_close(single.mean, every.mean, 1e-13)


def test_values_replace_the_declared_ones() -> None:
    values = {"tdoa.sigma": tensor(7.0), "start.sigma": tensor([1.0, 2.0, 3.0, 4.0])}
    sensor = tdoa(sigma=7.0)
    other = Filter(make().motion, (sensor,), start_sigma=(1.0, 2.0, 3.0, 4.0))
    assert torch.equal(run(FILTERS["ekf"], LOG, values).mean, run(other, LOG).mean)


def test_the_nlos_readings_cost_the_plain_filter_more_than_the_robust_one() -> None:
    log = airport_log(60, 20, missing=0.0, nlos=100.0)
    assert log.truth is not None
    error = {
        name: float(
            airport.position_errors(array(run(FILTERS[name], log).mean), array(log.truth)).mean()
        )
        for name in ("ekf", "m-ekf")
    }
    assert error["m-ekf"] < 0.8 * error["ekf"]


def test_a_belief_of_the_batch_is_left_as_it_was() -> None:
    filter = FILTERS["adaptive"]
    assert LOG.start is not None
    start = start_belief(filter, filter.prepare(), LOG.start)
    copy = Belief(
        start.mean.clone(),
        start.deviations.clone(),
        {k: v.clone() for k, v in start.memory.items()},
    )
    run(filter, LOG, start=start)
    assert torch.equal(start.mean, copy.mean)
    assert torch.equal(start.deviations, copy.deviations)
    assert all(torch.equal(start.memory[k], copy.memory[k]) for k in copy.memory)
