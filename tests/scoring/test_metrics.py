"""Errors, consistency and intervals against NumPy; rows that do not count never do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import array, assert_close, random_spd, tensor
from run_cases import FILTERS, airport_log

from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, stack_logs
from difffilter.logs.track import Track
from difffilter.running.batch import run
from difffilter.scenario.scenario import load_scenario
from difffilter.scenario.simulation import simulate
from difffilter.scoring.metrics import (
    Score,
    bootstrap_interval,
    mean_nees,
    nees,
    nees_states,
    nis_per_channel,
    paired_ratio,
    position_error,
    rejected,
    rmse,
    scored_rows,
)

STATES = ("x", "y", "vx", "vy")
LOG = airport_log(25, 4, seed=8)
TRACK = run(FILTERS["m-ekf"], LOG)
NAN = torch.nan


def gaps(log: Log) -> Log:
    """Truth missing in some rows, wholly in the last trajectory's end."""
    assert log.truth is not None
    truth = log.truth.clone()
    truth[3, 1] = truth[4, 2, 0] = NAN
    truth[10:, 3] = NAN
    return replace(log, truth=truth)


def known(log: Log) -> np.ndarray:
    assert log.truth is not None
    return np.isfinite(array(log.truth)).all(-1)


def test_rmse_is_numpys_over_the_rows_with_truth() -> None:
    log = gaps(LOG)
    assert log.truth is not None
    squared = ((array(TRACK.mean) - array(log.truth))[..., :2] ** 2).sum(-1)
    assert float(rmse(log, TRACK)) == pytest.approx(squared[known(log)].mean() ** 0.5, rel=1e-14)
    rows = known(log) & array(log.measured)
    measured = float(rmse(log, TRACK, "measured"))
    assert measured == pytest.approx(squared[rows].mean() ** 0.5, rel=1e-14)
    assert rows.sum() < known(log).sum()


def test_rows_that_do_not_count_hold_no_error_and_no_nan() -> None:
    log = gaps(LOG)
    rows = scored_rows(log, TRACK)
    assert np.array_equal(array(rows), known(log))
    for value in (position_error(log, TRACK), nees(log, TRACK)):
        assert value.isfinite().all()
    assert not position_error(log, TRACK)[10:, 3].any()


def test_padding_of_shorter_logs_never_counts() -> None:
    single = [LOG.select([i]).rows(0, steps) for i, steps in ((0, 25), (1, 11))]
    logs = [
        replace(
            log, z=log.z[:, 0], truth=log.truth[:, 0] if log.truth is not None else None, start=None
        )
        for log in single
    ]
    stacked = stack_logs(logs)
    start = LOG.select([0, 1]).start
    track = run(FILTERS["m-ekf"], stacked, start=start)
    assert scored_rows(stacked, track).sum() == 25 + 11
    parts = [run(FILTERS["m-ekf"], log, start=log.start) for log in single]
    squared = [position_error(log, part) for log, part in zip(single, parts, strict=True)]
    together = torch.cat([part.flatten() for part in squared])
    assert float(rmse(stacked, track)) == pytest.approx(float(together.mean().sqrt()), rel=1e-12)


def test_nees_is_numpys() -> None:
    log = gaps(LOG)
    assert log.truth is not None
    error = (array(TRACK.mean) - array(log.truth))[..., None]
    covariance = array(TRACK.covariance)
    full = (np.swapaxes(error, -1, -2) @ np.linalg.solve(covariance, error))[..., 0, 0]
    rows = known(log)
    assert_close(array(nees(log, TRACK))[rows], full[rows], 1e-9)
    assert nees_states(log, TRACK) == 4
    assert nees_states(log, TRACK, per_position=True) == 2
    error, covariance = error[..., :2, :], covariance[..., :2, :2]
    position = (np.swapaxes(error, -1, -2) @ np.linalg.solve(covariance, error))[..., 0, 0]
    assert_close(array(nees(log, TRACK, per_position=True))[rows], position[rows], 1e-10)


def test_nees_is_nan_where_the_covariance_is_singular_and_the_mean_leaves_it_out() -> None:
    deviations = TRACK.deviations.clone()
    deviations[3, 1] = 0.0
    deviations[7, 0, 2] = 0.0
    track = replace(TRACK, deviations=deviations)
    found, full = nees(LOG, track), nees(LOG, TRACK)
    singular = torch.zeros_like(found, dtype=torch.bool)
    singular[3, 1] = singular[7, 0] = True
    assert torch.equal(found.isnan(), singular)
    assert torch.equal(found[~singular], full[~singular])
    rows = torch.ones_like(singular)
    expected = float(full[~singular].mean()) / 4
    assert float(mean_nees(LOG, track, rows)) == pytest.approx(expected, rel=1e-12)
    rows[10:] = False
    expected = float(full[:10][~singular[:10]].mean()) / 4
    assert float(mean_nees(LOG, track, rows)) == pytest.approx(expected, rel=1e-12)


def test_the_gradient_of_the_mean_nees_is_finite_beside_a_singular_covariance() -> None:
    mask = torch.ones_like(TRACK.deviations)
    mask[3, 1] = 0.0
    scale = tensor(1.0).requires_grad_()
    track = replace(TRACK, deviations=TRACK.deviations * mask * scale)
    value = mean_nees(LOG, track, torch.ones_like(LOG.measured))
    (gradient,) = torch.autograd.grad(value, scale)
    assert float(gradient) == pytest.approx(-2.0 * float(value.detach()), rel=1e-9)


def test_nees_covers_the_true_states_that_the_system_estimates() -> None:
    assert LOG.truth is not None
    log = replace(LOG, truth=LOG.truth[..., [1, 0]], truth_states=("y", "x"))
    assert nees_states(log, TRACK) == 2
    assert_close(nees(log, TRACK), nees(LOG, TRACK, per_position=True), 1e-10)
    assert float(rmse(log, TRACK)) == pytest.approx(float(rmse(LOG, TRACK)), rel=1e-14)


def test_nis_is_numpys_per_present_channel() -> None:
    record = TRACK.record
    assert record is not None
    total, count = 0.0, 0
    for k in range(LOG.steps):
        for i in range(LOG.trajectories):
            seen = array(record.present[k, i])
            z = array(record.observed[k, i])[seen]
            s = z @ z.T + np.diag(array(record.noise[k, i])[seen])
            nu = array(record.innovation[k, i])[seen]
            total, count = total + nu @ np.linalg.solve(s, nu), count + seen.sum()
            assert float(record.nis[k, i]) == pytest.approx(nu @ np.linalg.solve(s, nu), rel=1e-9)
    assert float(nis_per_channel(TRACK)) == pytest.approx(total / count, rel=1e-12)


def test_a_filter_that_knows_the_noise_is_consistent() -> None:
    keys = {"faults.nlos.probability": 0.0, "world.steps": 40}
    scenario = load_scenario("airport-mlat", keys)
    log = simulate(scenario, 100, seed=3)
    values = {
        "motion.acceleration": tensor([0.01, 10.0 / 3**0.5]),
        "start.sigma": tensor([3.0, 3.0, 0.01, 0.01]),
    }
    system = scenario.system("ekf")
    assert isinstance(system, Recipe)
    track = run(system, log, values)
    assert float(nis_per_channel(track)) == pytest.approx(1.0, abs=0.03)
    assert float(nees(log, track, per_position=True).mean() / 2) == pytest.approx(1.0, abs=0.1)
    proud = run(system, log, values | {"tdoa.sigma": tensor(1.5)})
    assert float(nis_per_channel(proud)) > 2.0


def test_the_share_of_rejected_measurements_is_counted_per_channel() -> None:
    record = TRACK.record
    assert record is not None
    weight, present = array(record.weight), array(record.present)
    expected = [
        ((weight[..., i] < 0.1) & present[..., i]).sum() / present[..., i].sum() for i in range(7)
    ]
    found = rejected(TRACK)
    assert list(found) == list(LOG.channels)
    assert_close(tensor(list(found.values())), np.array(expected), 1e-12)
    assert max(found.values()) > 0.05
    assert rejected(TRACK, below=0.0) == dict.fromkeys(LOG.channels, 0.0)


def test_estimators_without_records_have_no_nis_and_no_weights() -> None:
    bare = replace(TRACK, record=None)
    assert nis_per_channel(bare).isnan()
    assert rejected(bare) == {}


def test_rows_without_an_estimate_never_count() -> None:
    mean, deviations = TRACK.mean.clone(), TRACK.deviations.clone()
    mean[5, 1], deviations[5, 1] = NAN, NAN
    track = replace(TRACK, mean=mean, deviations=deviations)
    assert not scored_rows(LOG, track)[5, 1]
    assert nees(LOG, track).isfinite().all()
    others = torch.ones(25, 4, dtype=torch.bool)
    others[5, 1] = False
    expected = position_error(LOG, TRACK)[others].mean().sqrt()
    assert float(rmse(LOG, track)) == pytest.approx(float(expected), rel=1e-14)


def test_truth_is_needed_by_name() -> None:
    bare = replace(LOG, truth=None, truth_states=())
    for metric in (rmse, scored_rows, position_error):
        with pytest.raises(InputError, match=r"truth: found none, expected truth_x"):
            metric(bare, TRACK)
    speeds = replace(LOG, truth=LOG.truth[..., 2:], truth_states=("vx", "vy"))  # type: ignore[index]
    with pytest.raises(InputError, match="expected truth_x"):
        rmse(speeds, TRACK)


def resampled(squared: np.ndarray, rows: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """4000 RMSEs of resampled trajectories."""
    total, count = (squared * rows).sum(0), rows.sum(0)
    at = rng.integers(squared.shape[1], size=(4000, squared.shape[1]))
    return np.sqrt(total[at].sum(1) / count[at].sum(1))


def test_the_bootstrap_interval_is_numpys(rng: np.random.Generator) -> None:
    squared = rng.gamma(1.0, 2.0, (30, 1)) * rng.gamma(2.0, 1.0, (1, 50))
    rows = rng.random((30, 50)) < 0.7
    low, high = bootstrap_interval(tensor(squared), torch.tensor(rows))
    expected = np.quantile(resampled(squared, rows, rng), [0.025, 0.975])
    value = np.sqrt(squared[rows].mean())
    assert low < value < high
    assert abs(low - expected[0]) < 0.1 * (high - low)
    assert abs(high - expected[1]) < 0.1 * (high - low)
    assert bootstrap_interval(tensor(squared), torch.tensor(rows)) == (low, high)
    assert bootstrap_interval(tensor(squared), torch.tensor(rows), seed=1) != (low, high)


def test_the_paired_ratio_cancels_what_trajectories_share(rng: np.random.Generator) -> None:
    base = rng.gamma(0.5, 4.0, (20, 60))
    rows = torch.tensor(rng.random((20, 60)) < 0.8)
    ratio, low, high = paired_ratio(tensor(0.49 * base), tensor(base), rows)
    assert (ratio, low, high) == (pytest.approx(0.7), pytest.approx(0.7), pytest.approx(0.7))
    other = rng.gamma(0.5, 4.0, (20, 60))
    ratio, low, high = paired_ratio(tensor(other), tensor(base), rows)
    seen = rows.numpy()
    assert ratio == pytest.approx(np.sqrt(other[seen].mean() / base[seen].mean()), rel=1e-12)
    assert low < ratio < high


def test_missing_rows_carry_no_error_into_an_interval() -> None:
    squared = torch.full((4, 3), torch.inf, dtype=torch.float64)
    squared[:2] = 4.0
    rows = torch.tensor([True, True, False, False]).unsqueeze(-1).expand(4, 3)
    assert bootstrap_interval(squared, rows) == (2.0, 2.0)


def test_the_standard_deviation_of_a_track_is_that_of_its_covariance(
    rng: np.random.Generator,
) -> None:
    covariance = random_spd(rng, 4, 3)
    deviations = tensor(np.linalg.cholesky(covariance))
    track = Track(STATES, (), torch.zeros(3), torch.zeros(3, 4), deviations)
    assert_close(track.covariance, covariance, 1e-13)
    assert_close(track.std, np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1)), 1e-13)
    assert track.named(("vy", "x")) == [3, 0]
    with pytest.raises(InputError, match="state: found 'z', expected one of x, y, vx, vy"):
        track.named(("z",))


@pytest.mark.parametrize(
    ("first", "last"), [(5, 9), (0, 0), (20, None), (None, 3), (24, 24), (None, None)]
)
@pytest.mark.parametrize("rows", ["all", "measured"])
def test_a_score_counts_rows_between_its_times_both_included(
    rows: str, first: int | None, last: int | None
) -> None:
    log = gaps(LOG)
    low = -np.inf if first is None else float(LOG.time[first])
    high = np.inf if last is None else float(LOG.time[last])
    score = Score(rows, low, high)
    time = array(LOG.time)
    inside = ((time >= low) & (time <= high))[:, None] & known(log)
    if rows == "measured":
        inside = inside & array(log.measured)
    assert inside.any()
    assert np.array_equal(array(scored_rows(log, TRACK, score)), inside)
    assert log.truth is not None
    squared = ((array(TRACK.mean) - array(log.truth))[..., :2] ** 2).sum(-1)
    expected = squared[inside].mean() ** 0.5
    assert float(rmse(log, TRACK, score)) == pytest.approx(expected, rel=1e-14)


def test_a_score_takes_each_trajectorys_own_times() -> None:
    shift = 10.0 * torch.arange(4).double()
    time = LOG.time.unsqueeze(-1) + shift
    log, track = replace(LOG, time=time), replace(TRACK, time=time)
    score = Score(first=float(time[3, 1]), last=float(time[9, 1]))
    rows = scored_rows(log, track, score)
    assert rows[:, 1].nonzero().flatten().tolist() == list(range(3, 10))
    assert not rows[:, [0, 2, 3]].any()
    one = replace(LOG, time=time[:, 1], z=LOG.z[:, 1], truth=LOG.truth[:, 1], start=None)  # type: ignore[index]
    single = replace(track, time=one.time, mean=TRACK.mean[:, 1], deviations=TRACK.deviations[:, 1])
    assert torch.equal(scored_rows(one, single, score), rows[:, 1])


def test_a_score_with_no_row_inside_counts_nothing() -> None:
    beyond = float(LOG.time[-1]) + 1.0
    assert not scored_rows(LOG, TRACK, Score(first=beyond)).any()
    assert scored_rows(LOG, TRACK, Score()).equal(scored_rows(LOG, TRACK))
    assert scored_rows(LOG, TRACK, Score("measured")).equal(scored_rows(LOG, TRACK, "measured"))


def test_a_row_that_does_not_count_may_have_a_singular_covariance() -> None:
    """A start whose velocity is known exactly."""
    assert LOG.truth is not None
    truth, deviations = LOG.truth.clone(), TRACK.deviations.clone()
    truth[0], deviations[0, :, 2:] = NAN, 0.0
    log, track = replace(LOG, truth=truth), replace(TRACK, deviations=deviations)
    found, expected = nees(log, track), nees(LOG, TRACK)
    assert torch.isnan(found[0]).all()
    assert_close(found[1:], expected[1:], 1e-12)
