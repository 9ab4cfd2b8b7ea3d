"""A filter that rejects everything after a jump, and its return with recovery."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers import array, assert_close, run_steps
from recovery_cases import (
    AT,
    JUMP,
    RECOVERIES,
    ROWS,
    TRUTH,
    axis_filter,
    jump_log,
    soft_values,
)
from torch import Tensor

from difffilter.core.beliefs import Record, belief
from difffilter.filters.filter import Filter
from difffilter.logs.log import stack_logs
from difffilter.logs.track import Track
from difffilter.motions.blocks import ConstantVelocity
from difffilter.robust.gate import Gate
from difffilter.robust.recovery import STREAK, Recovery
from difffilter.running.batch import run
from difffilter.running.tracker import Tracker
from difffilter.sensors.sensor import FunctionSensor
from difffilter.weights.registry import tanh, tukey

#: Rows after the jump from which on the position is right for good.
WITHIN = {"inflate": 25, "widen": 60}
#: Filters that reject, with either kind of recovery.
OPTIONS: dict[str, dict[str, object]] = {
    "gate": {},
    "soft-edged weight": {"gate": None, "weight": tukey},
    "m-ekf": {"gate": None, "weight": tanh, "iterations": 3, "standardise": "innovation"},
    "sensor's gate": {"scope": "sensor"},
}


def error(track: Track) -> Tensor:
    return (track.mean[:, 0] - TRUTH).abs()


def weights(track: Track) -> Tensor:
    assert isinstance(track.record, Record)
    return track.record.weight


def test_without_recovery_the_gate_rejects_for_ever() -> None:
    track = run(axis_filter(), jump_log())
    assert float(error(track)[:AT].max()) < 3.0
    assert not weights(track)[AT:].any()
    assert float(error(track)[AT:].min()) > 0.5 * JUMP


@pytest.mark.parametrize("name", list(WITHIN))
def test_with_recovery_the_filter_returns_to_stay(name: str) -> None:
    track = run(axis_filter(RECOVERIES[name]), jump_log())
    assert float(error(track)[AT + WITHIN[name] :].max()) < 5.0
    assert bool(weights(track)[AT + WITHIN[name] :].any())


@pytest.mark.parametrize("name", list(WITHIN))
def test_nothing_changes_before_the_given_number_of_rejections(name: str) -> None:
    filter = axis_filter(replace(RECOVERIES[name], rejections=7))
    track, plain = run(filter, jump_log()), run(axis_filter(), jump_log())
    assert torch.equal(track.mean[: AT + 7], plain.mean[: AT + 7])
    assert torch.equal(track.covariance[: AT + 7], plain.covariance[: AT + 7])


@pytest.mark.parametrize("name", list(WITHIN))
@pytest.mark.parametrize("kind", list(OPTIONS))
def test_every_kind_of_rejection_ends(name: str, kind: str) -> None:
    locked = run(axis_filter(**OPTIONS[kind]), jump_log(rows=AT + 20))
    freed = run(axis_filter(RECOVERIES[name], **OPTIONS[kind]), jump_log(rows=AT + 20))
    assert not weights(locked)[AT:].any()
    assert bool((weights(freed)[AT:] > 0.1).any())


@pytest.mark.parametrize("temperature", [1.0, 0.3])
@pytest.mark.parametrize("name", list(WITHIN))
def test_the_soft_form_feels_rejections_and_factor(name: str, temperature: float) -> None:
    filter = axis_filter(RECOVERIES[name])
    values = soft_values(filter, "recovery.rejections", "recovery.factor")
    track = run(filter, jump_log(rows=AT + 20), values, temperature=temperature)
    loss = (track.mean[:, 0] - TRUTH[: AT + 20]).square().mean()
    leaves = [values["recovery.rejections"], values["recovery.factor"]]
    for gradient in torch.autograd.grad(loss, leaves):
        assert bool(torch.isfinite(gradient))
        assert float(gradient.abs()) > 1e-6


@pytest.mark.parametrize("name", list(WITHIN))
def test_a_batch_recovers_each_trajectory_by_itself(name: str) -> None:
    filter = axis_filter(RECOVERIES[name])
    logs = [jump_log(), jump_log(gap=slice(AT, AT + 40)), jump_log(gap=slice(40, 60))]
    start = logs[0].start
    batch = run(filter, stack_logs(logs), start=start)
    for i, log in enumerate(logs):
        alone = run(filter, log, start=start)
        assert_close(batch.mean[:, i], alone.mean, 1e-10)
        assert_close(batch.covariance[:, i], alone.covariance, 1e-10)
        assert_close(weights(batch)[:, i], weights(alone), 1e-12)


@pytest.mark.parametrize("name", list(WITHIN))
def test_streaming_recovers_as_the_batch_run_does(name: str) -> None:
    filter, log = axis_filter(RECOVERIES[name]), jump_log(gap=slice(34, 37))
    expected = run(filter, log)
    tracker = Tracker(filter, [0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]])
    means = []
    for z in array(log.z):
        tracker.step(z.tolist(), dt=1.0)
        means.append(tracker.belief.mean.clone())
    assert_close(torch.stack(means), expected.mean, 1e-12)
    assert expected.final is not None
    assert_close(tracker.belief.covariance.clone(), expected.final.covariance, 1e-12)
    assert torch.equal(tracker.belief.memory[STREAK], expected.final.memory[STREAK])


@pytest.mark.parametrize("name", list(WITHIN))
def test_a_long_outage_within_a_lock_out_leaves_a_finite_prediction(name: str) -> None:
    """Rows without measurements, after more rejected ones than recovery waits for."""
    log = jump_log(gap=slice(AT + 6, ROWS))
    recovered, plain = run(axis_filter(RECOVERIES[name]), log), run(axis_filter(), log)
    grown = recovered.std[-1, 0] / plain.std[-1, 0]
    assert float(grown) < 10.0


def redundant(recovery: Recovery | None) -> Filter:
    sensor = FunctionSensor(
        ("p", "q", "r"), lambda x, inputs, values: x[..., :1].expand(*x.shape[:-1], 3), 1.0
    )
    motion = ConstantVelocity(1, acceleration=0.03)
    return Filter(motion, (sensor,), gate=Gate("reject"), recovery=recovery)


@pytest.mark.parametrize("name", list(WITHIN))
def test_one_faulty_channel_among_several_does_not_trigger_recovery(name: str) -> None:
    noise = 0.5 * torch.randn(60, 3, generator=torch.Generator().manual_seed(2)).double()
    noise[10:, 1] += JUMP
    state = belief(torch.zeros(2).double(), torch.eye(2).double())
    dt = torch.ones(60).double()
    plain = redundant(None)
    filter = redundant(RECOVERIES[name])
    expected, _ = run_steps(plain, plain.prepare(), state, noise, dt)
    start = filter.start(state.mean, state.deviations)
    found, records = run_steps(filter, filter.prepare(), start, noise, dt)
    assert all(not record.weight[1] for record in records[10:])
    for ours, theirs in zip(found, expected, strict=True):
        assert ours.memory[STREAK][[0, 2]].tolist() == [0.0, 0.0]
        assert torch.equal(ours.mean, theirs.mean)
        assert torch.equal(ours.deviations, theirs.deviations)
