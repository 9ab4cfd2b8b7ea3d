"""Streaming gives what the batch run gives, and an error changes nothing."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import assert_close, tensor
from run_cases import FILTERS, SHIFTED, airport_log, make, with_offset
from stream_cases import COVARIANCE, check

import difffilter
from difffilter.core.beliefs import Belief
from difffilter.errors import InputError, NonFiniteError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Start
from difffilter.running.batch import run
from difffilter.running.tracker import Tracker

LOG = airport_log()
MEAN = LOG.start.mean  # type: ignore[union-attr]


@pytest.fixture(autouse=True, params=["torch", "auto"])
def engine(
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """Every promise holds for both engines."""
    monkeypatch.setenv("DIFFFILTER_ENGINE", request.param)
    monkeypatch.setenv("DIFFFILTER_CACHE", str(tmp_path_factory.getbasetemp() / "cache"))


@pytest.mark.parametrize("name", FILTERS)
def test_streaming_is_the_batch_run(name: str) -> None:
    check(FILTERS[name], replace(LOG, z=LOG.z[:, 0], truth=None, truth_states=()), MEAN[0])


@pytest.mark.parametrize("name", ["mad", "adaptive"])
def test_streaming_many_trajectories_is_the_batch_run(name: str) -> None:
    check(FILTERS[name], LOG, MEAN)


def test_streaming_with_inputs_is_the_batch_run() -> None:
    check(SHIFTED, with_offset(LOG), MEAN)


def test_results_hold_no_graph_and_demand_none() -> None:
    tracker = Tracker(FILTERS["m-ekf"], MEAN[0], COVARIANCE)
    record = tracker.step(LOG.z[0, 0], 0.1)
    for part in (tracker.belief.mean, tracker.belief.deviations, record.weight):
        assert not part.requires_grad
        assert part.grad_fn is None
    assert not record.nis.requires_grad


def test_missing_channels_can_be_none_nan_or_left_out() -> None:
    z = LOG.z[0, 0].clone()
    z[:2] = tensor([12.0, -3.0])
    z[2:] = torch.nan
    listed = [12.0, -3.0, None, None, float("nan"), None, None]
    forms = [z, listed, {"tdoa_3": -3.0, "tdoa_2": 12.0, "tdoa_5": None}]
    means = []
    for form in forms:
        tracker = Tracker(FILTERS["imq"], MEAN[0], COVARIANCE)
        record = tracker.step(form, dt=0.1)  # type: ignore[arg-type]
        assert record.present.tolist() == [True, True] + [False] * 5
        means.append(tracker.belief.mean)
    assert torch.equal(means[0], means[1])
    assert torch.equal(means[0], means[2])


ERRORS: dict[str, tuple[Callable[[Tracker], object], str]] = {
    "too few": (lambda t: t.step([1.0] * 6, 0.1), r"z: found shape \[6\], expected \[7\]"),
    "too many": (lambda t: t.step(torch.zeros(8), 0.1), r"found shape \[8\], expected \[7\]"),
    "a batch": (lambda t: t.step(torch.zeros(2, 7), 0.1), r"shape \[2, 7\], expected \[7\]"),
    "a lone number": (lambda t: t.step(torch.tensor(1.0), 0.1), r"found shape \[\]"),
    "text": (lambda t: t.step(["north"] * 7, 0.1), "z: found .*north.*, expected numbers"),
    "unknown channel": (lambda t: t.step({"tdoa_9": 1.0}, 0.1), "channel 'tdoa_9', expected tdoa"),
    "infinite": (lambda t: t.step([float("inf")] * 7, 0.1), "infinite number"),
    "negative dt": (lambda t: t.step([1.0] * 7, -0.1), "dt: found -0.1, expected 0 or more"),
    "dt missing": (lambda t: t.step([1.0] * 7, float("nan")), "dt: found nan"),
}


@pytest.mark.parametrize("name", ERRORS)
def test_an_error_leaves_the_belief_as_it_was(name: str) -> None:
    attempt, message = ERRORS[name]
    tracker = Tracker(FILTERS["adaptive"], MEAN[0], COVARIANCE)
    tracker.step(LOG.z[0, 0], 0.1)
    before: Belief = tracker.belief
    mean = before.mean.clone()
    with pytest.raises(InputError, match=message):
        attempt(tracker)
    assert tracker.belief is before
    assert torch.equal(before.mean, mean)
    assert tracker.steps == 1


def test_a_step_that_overflows_is_named_and_undone() -> None:
    tracker = Tracker(FILTERS["ekf"], MEAN[0], COVARIANCE)
    tracker.step(LOG.z[0, 0], 0.1)
    before = tracker.belief
    with pytest.raises(NonFiniteError) as caught:
        tracker.step([None] * 7, 1e308)
    assert (caught.value.trajectory, caught.value.step) == (0, 1)
    assert caught.value.channel in FILTERS["ekf"].states
    assert tracker.belief is before
    tracker.step(LOG.z[1, 0], 0.1)  # and it goes on
    assert tracker.steps == 2


@pytest.mark.parametrize(
    ("mean", "covariance", "message"),
    [
        ([1.0, 2.0], [[1.0, 0.0], [0.0, 1.0]], r"found 2 numbers, expected 4 \(x, y, vx, vy\)"),
        ([1.0] * 4, [[1.0]], "covariance: found shape"),
        ([1.0] * 4, (-torch.eye(4)).tolist(), "negative eigenvalue"),
        ([float("nan")] * 4, torch.eye(4).tolist(), "not finite"),
    ],
)
def test_a_belief_that_does_not_fit_is_refused(
    mean: list[float], covariance: list[list[float]], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Tracker(make(), mean, covariance)


def test_values_and_precision_are_those_given() -> None:
    values = {name: value.float() for name, value in make().published().items()}
    values["tdoa.sigma"] = torch.tensor(9.0)
    tracker = Tracker(make(), MEAN[0].tolist(), COVARIANCE.tolist(), values)
    tracker.step(LOG.z[0, 0], 0.1)
    assert tracker.belief.mean.dtype == torch.float32
    log = replace(LOG.rows(0, 1), z=LOG.z[:1, 0], time=tensor([0.1]), truth=None, truth_states=())
    other = {"tdoa.sigma": tensor(9.0)}
    expected = run(make(), log, other, start=Start(MEAN[0], COVARIANCE, 0.0))
    assert_close(tracker.belief.mean.double(), expected.mean[0], 1e-5)


@pytest.mark.parametrize("temperature", [None, 0.3])
def test_a_loaded_checkpoint_tracks_like_the_frozen_filter(
    tmp_path: Path, temperature: float | None
) -> None:
    scenario = difffilter.load_scenario("airport-mlat-intermittent", {"world.steps": 15})
    system = scenario.system("m-ekf")
    assert isinstance(system, Recipe)
    values = system.published() | {"tdoa.sigma": tensor(4.2), "tanh.ab": tensor([1.1, 2.9])}
    checkpoint = difffilter.Checkpoint(scenario, "m-ekf", values, temperature)
    difffilter.save(checkpoint, tmp_path / "x.json")
    log = difffilter.simulate(scenario, 1, seed=3)
    assert log.start is not None
    tracker = difffilter.load(tmp_path / "x.json").tracker(log.start.mean[0], COVARIANCE)
    start = Start(log.start.mean, COVARIANCE.expand(1, 4, 4), 0.0)
    expected = run(system, log, values, start, temperature=temperature)
    for row in range(log.steps):
        tracker.step(log.z[row, 0], float(log.intervals(0.0)[row]))
        assert_close(tracker.belief.mean, expected.mean[row, 0], 1e-12)
