"""Plug-ins of paper 4 against oracles in NumPy, missing channels, soft forms, gradients."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from fusion_cases import (
    ADAPTATIONS,
    P0,
    SCENES,
    WEIGHTS,
    bent_log,
    estimated,
    free_values,
    make,
    measured,
    physical,
)
from helpers import array, assert_close, number, one, predicted_z, tdoa_filter, tensor
from oracles import cubature
from stream_cases import stream
from torch import Tensor

import difffilter as df
from difffilter.adaptation import (
    Chain,
    InnovationMatching,
    MultipleFading,
    PredictionCorrection,
    StrongTracking,
)
from difffilter.adaptation.fading import AVERAGE, STARTED
from difffilter.adaptation.matching import BEFORE, FLAG, MATCHED, RING
from difffilter.core.beliefs import Belief, Measurement, belief
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.prediction import linearise, predict
from difffilter.filters.recipe import Recipe
from difffilter.filters.stepping import step
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.batch import run
from difffilter.running.tracker import Tracker
from difffilter.sensors.builtin import Range
from difffilter.weights.registry import huber

NAN = torch.nan
NOISE = np.full(2, 49.0)  # of fusion_cases.position


@pytest.mark.parametrize("system", cubature.FILTERS)
@pytest.mark.parametrize("name", SCENES)
def test_over_a_whole_scene_a_filter_is_that_of_the_oracle(name: str, system: str) -> None:
    track = estimated(name, system)
    z, start = measured(name, "r")
    for b in range(2):
        mean, cov = cubature.FILTERS[system](z[:, b], start[b], P0, np.full(2, 50.0))
        assert_close(track.mean[:, b], mean, 1e-10)
        assert_close(track.covariance[:, b], cov, 1e-8)


@pytest.mark.parametrize("name", SCENES)
def test_matching_and_correction_in_a_chain_are_those_of_the_oracle(name: str) -> None:
    track = estimated(name, "pooled-robust")
    z, start = measured(name, "pooled")
    for b in range(2):
        mean, cov = cubature.matched_and_corrected(z[:, b], start[b], P0, np.full(2, 25.0))
        assert_close(track.mean[:, b], mean, 1e-10)
        assert_close(track.covariance[:, b], cov, 1e-8)


@pytest.mark.parametrize("weight", WEIGHTS)
@pytest.mark.parametrize("name", ADAPTATIONS)
def test_on_a_linear_model_cubature_and_taylor_adapt_alike(name: str, weight: str) -> None:
    tracks = []
    for rule in ("taylor", "cubature"):
        filter = make(name, WEIGHTS[weight], rule)
        log = bent_log(filter)
        tracks.append(run(filter, log))
    assert_close(tracks[1].mean, tracks[0].mean, 1e-10)
    assert_close(tracks[1].covariance, tracks[0].covariance, 1e-9)
    plain = run(make(None, WEIGHTS[weight]), log)
    assert number((tracks[0].mean - plain.mean).abs().max()) > 1.0  # it does adapt


@pytest.mark.parametrize("name", ["matching", "correction", "strong tracking", "multiple fading"])
def test_rows_without_a_measurement_leave_the_memory_alone(name: str) -> None:
    filter = make(name)
    log = bent_log(filter)

    def until(row: int, z: Tensor) -> df.Track:
        short = replace(log, z=z[:row], time=log.time[:row], truth=None, truth_states=())
        return run(filter, short)

    before, z = until(4, log.z), log.z.clone()  # row 3 is off, flagged
    z[4:6] = NAN
    after = until(6, z)
    assert before.final is not None
    assert after.final is not None
    assert set(after.final.memory) == set(before.final.memory)
    for key, value in before.final.memory.items():
        if key == FLAG:
            assert not after.final.memory[key].any()
        elif key != BEFORE:
            assert torch.equal(after.final.memory[key], value), key
    assert_close(
        after.mean[-1], array(before.mean[-1]) @ (cubature.F @ cubature.F).T, 1e-13
    )  # prediction alone


@pytest.mark.parametrize("rule", ["taylor", "cubature"])
@pytest.mark.parametrize("name", ADAPTATIONS)
def test_a_missing_channel_does_not_reach_the_others(name: str, rule: str) -> None:
    """With one axis missing throughout the other is a filter of its own."""
    filter = make(name, rule=rule)
    log = bent_log(filter)
    z = log.z.clone()
    z[..., 1] = NAN
    track = run(filter, replace(log, z=z))
    assert bool(torch.isfinite(track.mean).all())
    one_axis = Filter(
        ConstantVelocity(1, "state", 1.0),
        (df.Position(axes=1, sigma=7.0, channels=("x",)),),
        adaptation=(
            Chain((InnovationMatching(), PredictionCorrection(1)))
            if name == "chain"
            else PredictionCorrection(1)
            if name == "correction"
            else filter.adaptation
        ),
        linearise=rule,
        start_sigma=(50.0**0.5, 10.0**0.5),
    )
    start = log.start
    assert start is not None
    alone = replace(
        log, channels=("x",), z=log.z[..., :1], truth=None, truth_states=(),
        start=replace(start, mean=start.mean[:, [0, 2]]),
    )  # fmt: skip
    expected = run(one_axis, alone)
    assert_close(track.mean[..., [0, 2]], expected.mean, 1e-9)
    found = track.covariance[..., [0, 2], :][..., [0, 2]]
    assert_close(found, expected.covariance, 1e-8)


@pytest.mark.parametrize("name", ADAPTATIONS)
def test_the_memory_is_explicit_and_starts_at_its_declared_value(name: str) -> None:
    filter = make(name)
    mean, deviations = torch.zeros(3, 4).double(), torch.eye(4).double().expand(3, 4, 4)
    started = filter.start(mean, deviations)
    assert filter.adaptation is not None
    declared = filter.adaptation.memory(mean, 2)
    assert set(started.memory) == set(declared)
    for key, value in declared.items():
        torch.testing.assert_close(started.memory[key], value, rtol=0, atol=0, equal_nan=True)
        assert value.shape[0] == 3
        assert not torch.nan_to_num(value).any()
    constants = filter.prepare()
    before = {key: value.clone() for key, value in started.memory.items()}
    z = tensor([[90.0, 5.0], [1.0, 2.0], [NAN, NAN]])
    after, _ = step(filter, constants, started, Measurement(z, tensor(1.0)))
    assert set(after.memory) == set(declared)
    for key, value in before.items():  # the step writes nothing into what it was given
        torch.testing.assert_close(started.memory[key], value, rtol=0, atol=0, equal_nan=True)
        assert after.memory[key].shape == value.shape
    again, _ = step(filter, constants, started, Measurement(z, tensor(1.0)))
    assert torch.equal(again.mean, after.mean)


@pytest.mark.parametrize("weight", WEIGHTS)
@pytest.mark.parametrize("name", ADAPTATIONS)
def test_streaming_is_the_batch_run(name: str, weight: str) -> None:
    filter = make(name, WEIGHTS[weight])
    log = bent_log(filter)
    log = replace(log, z=log.z.clone(), truth=None, truth_states=())
    log.z[5, 1, 0] = log.z[8, 2] = NAN
    expected = run(filter, log)
    assert log.start is not None
    assert expected.final is not None
    found = stream(Tracker(filter, log.start.mean, tensor(P0).expand(3, 4, 4)), log)
    assert_close(found.mean, expected.mean, 1e-12)
    assert_close(found.covariance, expected.covariance, 1e-11)
    assert found.final is not None
    for key, value in expected.final.memory.items():
        assert_close(found.final.memory[key], value, 1e-11)


@pytest.mark.parametrize("name", ADAPTATIONS)
def test_each_trajectory_is_the_one_run_alone(name: str) -> None:
    filter = make(name, huber)
    log = bent_log(filter)
    together = run(filter, log)
    for i in range(3):
        alone = run(filter, log.select([i]))
        assert_close(together.mean[:, i], alone.mean[:, 0], 1e-12)
        assert_close(together.covariance[:, i], alone.covariance[:, 0], 1e-11)


@pytest.mark.parametrize("name", ADAPTATIONS)
def test_the_soft_form_becomes_the_hard_one_as_the_temperature_falls(name: str) -> None:
    filter = make(name, huber)
    log = bent_log(filter)
    hard = run(filter, log)
    scale = number((hard.mean - run(make(None, huber), log).mean).abs().max())
    errors = [
        number((run(filter, log, temperature=t).mean - hard.mean).abs().max())
        for t in (0.5, 0.02, 1e-3, 1e-5)
    ]
    assert errors[0] > 1e-4 * scale
    assert errors[-1] < 1e-3 * scale
    assert errors[-1] < 0.05 * errors[0]


EXPECTED = {
    "matching": {"matching.beta", "matching.rate"},
    "correction": {"correction.lambda"},
    "strong tracking": {"fading.beta", "fading.rho"},
    "multiple fading": {"fading.beta", "fading.rho"},
    "chain": {"matching.beta", "matching.rate", "correction.lambda"},
}


@pytest.mark.parametrize("rule", ["taylor", "cubature"])
@pytest.mark.parametrize("name", ADAPTATIONS)
def test_the_soft_form_has_a_gradient_towards_every_parameter(name: str, rule: str) -> None:
    filter = make(name, huber, rule)
    log = bent_log(filter)
    assert log.truth is not None
    names, free = free_values(filter)
    assert set(names) >= EXPECTED[name] | {"huber.k", "motion.state_sigma", "position.sigma"}
    track = run(filter, log, physical(filter, free), temperature=0.5)
    loss = (track.mean - log.truth).square().mean() + track.covariance.square().mean()
    for key, gradient in zip(names, torch.autograd.grad(loss, free), strict=True):
        assert bool(torch.isfinite(gradient).all()), key
        assert bool(gradient.any()), key


@pytest.mark.parametrize("rule", ["taylor", "cubature"])
@pytest.mark.parametrize("name", ADAPTATIONS)
def test_a_soft_step_passes_gradcheck(name: str, rule: str) -> None:
    filter = make(name, huber, rule)
    log = bent_log(filter)
    constants = filter.prepare()
    assert log.start is not None
    state = filter.start(log.start.mean[0], torch.diag(tensor(P0.diagonal() ** 0.5)))
    for k in range(5):  # past the outlier, so that the memory tells of something
        state, _ = step(filter, constants, state, Measurement(log.z[k, 0], tensor(1.0)))
    z = predicted_z(filter, state, 1.0, constants) + tensor([60.0, -31.0])
    names, free = free_values(filter)
    at = names.index("start.sigma")  # no part of a step
    free = [*free[:at], *free[at + 1 :]]

    def posterior(mean: Tensor, deviations: Tensor, *free: Tensor) -> tuple[Tensor, ...]:
        start = filter.declarations["start.sigma"]
        full = [*free[:at], start.constraint.free(start.tensor()), *free[at:]]
        values = filter.prepare(physical(filter, full), temperature=0.5)
        before = Belief(mean, deviations.tril(), state.memory)
        after, record = step(filter, values, before, Measurement(z, tensor(1.0)))
        return after.mean, after.covariance, record.weight, record.noise

    leaves = (state.mean.clone().requires_grad_(), state.deviations.clone().requires_grad_())
    assert torch.autograd.gradcheck(posterior, (*leaves, *free), atol=1e-5, rtol=1e-4, eps=1e-5)


def test_a_raised_measurement_noise_is_the_clamped_actual_variance() -> None:
    filter = make("matching")
    state = belief(torch.zeros(4).double(), tensor(P0))
    variance = np.array([50 + 10 + 1 + 49.0] * 2)
    e = np.array([200.0, 5.0])
    actual = 0.25 * e**2 + 0.75 * variance
    after, record = one(filter, filter.start(*state[:2]), tensor(e), 1.0)
    assert actual.sum() > 9 * variance.sum()
    assert actual[1] < variance[1]  # so that one channel is clamped
    expected = np.maximum(NOISE, actual - (variance - NOISE))
    assert_close(record.noise, expected, 1e-12)
    assert expected[1] == 49.0
    assert after.memory[FLAG].tolist() == 1.0
    assert after.memory[MATCHED].tolist() == 1.0
    assert_close(after.memory[RING][-1], variance, 1e-12)


def test_a_weight_beside_the_matching_is_that_of_the_raised_noise() -> None:
    filter = make("matching", huber)
    state = filter.start(torch.zeros(4).double(), torch.diag(tensor(P0.diagonal() ** 0.5)))
    _, record = one(filter, state, tensor([200.0, 5.0]), 1.0)
    raised = 0.25 * 200.0**2 + 0.75 * 110.0 - 61.0
    assert_close(record.standardised, np.array([200.0 / raised**0.5, 5.0 / 7.0]), 1e-11)
    assert_close(record.weight, np.array([1.345 * raised**0.5 / 200.0, 1.0]), 1e-11)


@pytest.mark.parametrize("name", ["strong tracking", "multiple fading"])
def test_the_average_starts_at_the_first_innovation_however_late(name: str) -> None:
    filter = make(name)
    state = filter.start(torch.zeros(4).double(), torch.diag(tensor(P0.diagonal() ** 0.5)))
    state, _ = one(filter, state, tensor([NAN, NAN]), 1.0)
    assert number(state.memory[STARTED]) == 0.0
    state, record = one(filter, state, tensor([30.0, -4.0]), 1.0)
    first = record.innovation.square()
    assert torch.equal(state.memory[AVERAGE], first)
    state, record = one(filter, state, tensor([40.0, 9.0]), 1.0)
    expected = (0.95 * first + record.innovation.square()) / 1.95
    assert_close(state.memory[AVERAGE], expected, 1e-14)


def test_a_lasting_change_is_believed_in_the_end() -> None:
    filter = make("matching")
    state = filter.start(torch.zeros(4).double(), torch.diag(tensor(P0.diagonal() ** 0.5)))
    before, count = 0.0, 0
    while True:
        state, _ = one(filter, state, tensor([400.0, 0.0]), 1.0)
        if number(state.memory[FLAG]) == 0.0:
            break
        count += 1
        assert count < 20
        assert number(state.memory[MATCHED]) == count
        before = number(state.mean[0])
    assert count >= 2
    assert before < 300.0
    assert number(state.memory[MATCHED]) == 0.0
    assert abs(number(state.mean[0]) - 400.0) < abs(before - 400.0)


def test_a_chain_is_its_parts_one_after_the_other() -> None:
    chained, bare = make("chain"), make(None)
    matching, correction = InnovationMatching(), PredictionCorrection(2)
    log = bent_log(chained, runs=2)
    assert log.start is not None
    constants = chained.prepare()
    state = chained.start(log.start.mean, torch.diag(tensor(P0.diagonal() ** 0.5)).expand(2, 4, 4))
    for z in log.z:
        row = Measurement(z, tensor(1.0))
        linear, present = linearise(bare, constants, predict(bare, constants, state, row), row)
        linear, memory = matching.before_condition(state.memory, linear, present, {}, constants)
        linear, memory = correction.before_condition(memory, linear, present, {}, constants)
        mean, cov = array(linear.mean), array(linear.deviations @ linear.deviations.mT)
        state, record = step(chained, constants, state, row)
        assert_close(record.noise, linear.independent, 1e-13)
        for b in range(2):
            expected = cubature.update(mean[b], cov[b], array(z[b]), array(linear.independent[b]))
            assert_close(state.mean[b], expected[0], 1e-11)
            assert_close(state.covariance[b], expected[1], 1e-10)
        for key, value in memory.items():
            assert torch.equal(state.memory[key], value)
    assert {p.name for p in Chain((matching, correction)).parameters} == EXPECTED["chain"]


def test_the_streak_of_the_matching_reaches_the_correction() -> None:
    filter = make("chain")
    deviations = torch.diag(tensor(P0.diagonal() ** 0.5))
    start = filter.start(torch.zeros(4).double(), deviations)
    z, shifts = tensor([60.0, 0.0]), []  # corrected, not flagged
    for m in (0.0, 1.0, 3.0):
        state = start._replace(memory={**start.memory, MATCHED: tensor(m)})
        constants = filter.prepare()
        row = Measurement(z, tensor(1.0))
        linear, present = linearise(filter, constants, predict(filter, constants, state, row), row)
        assert filter.adaptation is not None
        moved, memory = filter.adaptation.before_condition(
            state.memory, linear, present, {}, constants
        )
        assert number(memory[FLAG]) == 0.0
        shift = moved.mean - linear.mean
        d = 60.0 - 2.0 * 110.0**0.5
        cov = array(linear.deviations @ linear.deviations.mT)
        rate = min(1.0 / (m + 1.0), 5.0 * cov[2, 0] / cov[0, 0])
        assert_close(shift, np.array([d, 0.0, d * rate, 0.0]), 1e-11)
        shifts.append(shift)
    alone = make("correction")
    after, _ = one(alone, alone.start(start.mean, deviations), z, 1.0)
    expected = cubature.update(
        array(shifts[0]), cubature.F @ P0 @ cubature.F.T + np.eye(4), array(z), NOISE
    )
    assert_close(after.mean, expected[0], 1e-11)


@pytest.mark.parametrize("temperature", [None, 0.5])
@pytest.mark.parametrize("name", ADAPTATIONS)
def test_two_rows_at_one_time_are_finite_in_value_and_gradient(
    name: str, temperature: float | None
) -> None:
    filter = make(name)
    log = bent_log(filter)
    time = log.time.clone()
    time[4] = time[3]  # row 3 is off by 150 m, row 4 contradicts it
    log = replace(log, time=time)
    sigma = tensor(7.0).requires_grad_()
    track = run(filter, log, {"position.sigma": sigma}, temperature=temperature)
    (gradient,) = torch.autograd.grad(track.mean.square().mean(), sigma)
    assert bool(torch.isfinite(gradient))
    assert number(gradient) != 0.0


def test_without_any_time_the_correction_moves_the_position_alone() -> None:
    filter = make("correction")
    start = filter.start(torch.zeros(4).double(), torch.diag(tensor(P0.diagonal() ** 0.5)))
    after, _ = one(filter, start, tensor([100.0, 0.0]), 0.0)
    d = 100.0 - 2.0 * (50.0 + 49.0) ** 0.5
    moved = np.array([d, 0.0, 0.0, 0.0])
    expected = cubature.update(moved, P0, np.array([100.0, 0.0]), NOISE)
    assert_close(after.mean, expected[0], 1e-12)


def test_a_correction_by_ranges_is_the_least_squares_solution() -> None:
    anchors = np.array([[100.0, 0.0], [0.0, 80.0], [-60.0, -70.0]])
    sensor = Range(stations=anchors.tolist(), sigma=1.0)
    filter = Filter(
        ConstantVelocity(2, "state", 1.0), (sensor,), adaptation=PredictionCorrection(2)
    )
    state = belief(torch.zeros(4).double(), torch.eye(4).double())
    constants = filter.prepare()
    h = -anchors / np.linalg.norm(anchors, axis=1)[:, None]
    e = np.array([30.0, -20.0, 1.0])
    row = Measurement(tensor(np.linalg.norm(anchors, axis=1) + e), tensor(2.0))
    predicted = predict(filter, constants, filter.start(*state[:2]), row)
    linear, present = linearise(filter, constants, predicted, row)
    assert filter.adaptation is not None
    moved, _ = filter.adaptation.before_condition({}, linear, present, {}, constants)
    cov = array(predicted.deviations @ predicted.deviations.mT)[:2, :2]
    d = cubature.excess(e, np.diag(h @ cov @ h.T) + 1.0)
    delta = np.linalg.lstsq(h, d, rcond=None)[0]
    assert_close(moved.mean, np.concatenate([delta, delta / 2.0]), 1e-9)
    assert_close(
        moved.deviations @ moved.deviations.mT,
        predicted.deviations @ predicted.deviations.mT,
        1e-13,
    )


def test_a_singular_belief_is_faded_and_corrected_without_a_fault() -> None:
    for name in ADAPTATIONS:
        for rule in ("taylor", "cubature"):
            filter = make(name, rule=rule)
            sigma = tensor(7.0).requires_grad_()
            constants = filter.prepare({"position.sigma": sigma})
            deviations = torch.diag(tensor([7.0, 7.0, 0.0, 0.0]))
            state = filter.start(torch.zeros(4).double(), deviations)
            after, _ = step(
                filter, constants, state, Measurement(tensor([150.0, 3.0]), tensor(1.0))
            )
            assert bool(torch.isfinite(after.covariance).all())
            (gradient,) = torch.autograd.grad(after.mean.sum() + after.covariance.sum(), sigma)
            assert bool(torch.isfinite(gradient))


def test_nothing_fades_while_the_prediction_explains_the_innovations() -> None:
    calm = tensor([3.0, -2.0])
    for name in ADAPTATIONS:
        filter, bare = make(name), make(None)
        state = filter.start(torch.zeros(4).double(), torch.diag(tensor(P0.diagonal() ** 0.5)))
        found, _ = one(filter, state, calm, 1.0)
        expected, _ = one(bare, bare.start(*state[:2]), calm, 1.0)
        assert_close(found.mean, expected.mean, 1e-12)
        assert_close(found.covariance, expected.covariance, 1e-12)


def test_m_ekf_of_the_airport_with_strong_tracking_is_a_line_of_configuration() -> None:
    key = "systems.m-ekf.adaptation"
    log = df.simulate(df.load_scenario("airport-mlat", {"world.steps": 25}), 4, 3)
    tracks = {}
    for value in ("none", "strong-tracking", "multiple-fading", ["innovation-matching"]):
        scenario = df.load_scenario("airport-mlat", {"world.steps": 25, key: value})
        filter = scenario.system("m-ekf")
        assert isinstance(filter, Recipe)
        assert filter.iterations == 5
        values = {k: v.requires_grad_() for k, v in filter.published().items()}
        track = df.estimate(filter, df.started(scenario, filter, log, values), values)
        gradient = torch.autograd.grad(track.mean.square().mean(), values["tdoa.sigma"])[0]
        assert bool(torch.isfinite(gradient))
        tracks[str(value)] = track
    assert isinstance(
        df.load_scenario("airport-mlat", {key: "strong-tracking"}).system("m-ekf").adaptation,  # type: ignore[union-attr]
        StrongTracking,
    )
    final = tracks["strong-tracking"].final
    assert final is not None
    assert final.memory[STARTED].tolist() == [1.0] * 4
    assert not torch.allclose(tracks["strong-tracking"].mean, tracks["none"].mean, atol=1e-3)
    for track in tracks.values():
        assert track.record is not None
        assert bool((track.record.weight < 0.99).any())


@pytest.mark.parametrize("rule", ["taylor", "cubature"])
@pytest.mark.parametrize("name", ADAPTATIONS)
def test_every_adaptation_runs_with_nonlinear_sensors_and_the_m_ekf(name: str, rule: str) -> None:
    plug_in = ADAPTATIONS[name](huber)
    filter = tdoa_filter(
        weight=huber, iterations=2, weigh_prior=True, adaptation=plug_in, linearise=rule
    )
    state = belief(tensor([500.0, 700.0, 1.0, 14.0]), tensor(P0))
    z = predicted_z(filter, state, 0.5, filter.prepare())
    state = filter.start(*state[:2])
    calm, _ = one(filter, state, z + tensor([1.0, -1.0, 0.5, 0.0, 1.0, -0.5, 0.3]), 0.5)
    struck, record = one(filter, state, z + tensor([400.0, 5, -9, 0, 1, -8, NAN]), 0.5)
    for after in (calm, struck):
        assert bool(torch.isfinite(after.mean).all())
        assert bool((torch.linalg.eigvalsh(after.covariance) > 0).all())
    assert number(record.weight[0]) < 1.0 or number(struck.memory.get(FLAG, tensor(0.0))) == 1.0
    assert not torch.equal(calm.mean, struck.mean)


def test_a_window_too_short_is_an_input_error() -> None:
    with pytest.raises(InputError, match="matching window: found 1, expected 2 or more"):
        InnovationMatching(1)


def test_each_state_of_multiple_fading_has_the_factor_of_the_channels_that_see_it() -> None:
    filter = make("multiple fading")
    assert isinstance(filter.adaptation, MultipleFading)
    state = filter.start(torch.zeros(4).double(), torch.diag(tensor(P0.diagonal() ** 0.5)))
    constants = filter.prepare()
    row = Measurement(tensor([200.0, 0.0]), tensor(1.0))
    predicted = predict(filter, constants, state, row)
    linear, present = linearise(filter, constants, predicted, row)
    faded, _ = filter.adaptation.before_condition(state.memory, linear, present, {}, constants)
    before, after = (array(x.deviations @ x.deviations.mT) for x in (linear, faded))
    factor = (200.0**2 - 1.0 - 4.5 * 49.0) / 60.0  # of channel x: N over M
    moved = before - np.eye(4)
    root = np.diag(np.sqrt([factor, 1.0, factor, 1.0]))
    assert_close(after, root @ moved @ root + np.eye(4), 1e-11)
