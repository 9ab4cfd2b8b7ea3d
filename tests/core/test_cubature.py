"""Cubature steps against the textbook's: linear models, nonlinear sensors and motion, weights."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import (
    MATRIX,
    STATIONS,
    array,
    assert_close,
    linear_filter,
    number,
    one,
    plane_belief,
    predicted_z,
    run_steps,
    tdoa_filter,
    tensor,
)
from oracles import airport, cubature, kinematics, textbook
from oracles import weights as published
from run_cases import airport_log
from stream_cases import COVARIANCE, check
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, belief
from difffilter.core.cubature import halves, moments, points
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.stepping import step
from difffilter.motions.blocks import ConstantVelocity, FunctionMotion
from difffilter.robust.gate import Gate
from difffilter.robust.recovery import Recovery
from difffilter.sensors.builtin import TDOA, Bearing, Position, Range
from difffilter.sensors.sensor import FunctionSensor
from difffilter.weights.registry import huber, imq, tanh

NAN = torch.nan
ANCHORS = np.array([[480.0, 650.0], [530.0, 690.0], [495.0, 740.0]])
WEST = ((580.0, 700.0), (570.0, 702.0))
DT = 0.5


def test_points_have_the_mean_and_covariance_that_they_stand_for(
    rng: np.random.Generator,
) -> None:
    state = plane_belief(rng, 3)
    cloud = points(state.mean, state.deviations)
    assert cloud.shape == (8, 3, 4)
    mean, deviations = moments(cloud)
    assert_close(mean, state.mean, 1e-14)
    assert_close(deviations @ deviations.mT, state.covariance, 1e-13)
    expected = cubature.cubature_points(array(state.mean[0]), array(state.covariance[0]))
    assert_close(cloud[:, 0], expected, 1e-13)


def test_the_columns_of_a_linear_function_of_the_points_are_its_own(
    rng: np.random.Generator,
) -> None:
    state, h = plane_belief(rng), tensor(MATRIX)
    _, deviations = moments(points(state.mean, state.deviations) @ h.mT)
    assert_close(halves(deviations, 4), h @ state.deviations, 1e-12)
    assert torch.equal(halves(state.deviations, 4), state.deviations)


@pytest.mark.parametrize("linear", [True, False])
@pytest.mark.parametrize("batch", [(), (2, 3)])
def test_on_a_linear_model_the_cubature_filter_is_the_kalman_filter(
    rng: np.random.Generator, batch: tuple[int, ...], linear: bool
) -> None:
    state, filter = plane_belief(rng, *batch), linear_filter(linearise="cubature")
    if not linear:  # the same motion, through its points
        filter = replace(filter, motion=pointwise(0.8))
    dts = rng.uniform(0.1, 2.0, 12)
    dts[4] = 0.0
    z = 500 * rng.standard_normal((12, *batch, 3))
    beliefs, _ = run_steps(filter, filter.prepare(), state, tensor(z), tensor(dts))
    mean, cov = array(state.mean), array(state.covariance)
    for k in range(12):
        process = kinematics.discrete_noise(0.8**2 * np.eye(2), dts[k])
        mean, cov = textbook.predict(mean, cov, kinematics.transition(2, dts[k]), process)
        noise = np.diag([0.25, 1.0, 4.0])
        mean, cov = textbook.kalman_update(mean, cov, z[k] - mean @ MATRIX.T, MATRIX, noise)
        assert_close(beliefs[k].mean, mean, 1e-10)
        assert_close(beliefs[k].covariance, cov, 1e-10)
        assert beliefs[k].deviations.shape[-1] == 4


def pointwise(level: float) -> FunctionMotion:
    """Constant velocity as a user's function."""
    known = ConstantVelocity(2, acceleration=level)
    constants = known.prepare({"motion.acceleration": tensor(level)})

    def move(state: Tensor, dt: Tensor, inputs: object, values: object) -> Tensor:
        return known.transition(state, dt, {}, {})

    return FunctionMotion(known.states, move, lambda m, dt, i, _: known.noise(m, dt, i, constants))


def ranges(x: np.ndarray) -> np.ndarray:
    return np.hypot(*(x[:2] - ANCHORS).T)


def bearings(x: np.ndarray) -> np.ndarray:
    return np.arctan2(*(x[:2] - ANCHORS).T[::-1])


def tdoas(x: np.ndarray) -> np.ndarray:
    return airport.range_differences(x[None])[0]


#: Sensor, its function, sigma, period and where the target is.
NONLINEAR = {
    "range": (Range(stations=ANCHORS.tolist(), sigma=2.0), ranges, 2.0, np.inf, (500.0, 700.0)),
    "bearing": (
        Bearing(stations=ANCHORS.tolist(), sigma=0.02),
        bearings,
        0.02,
        2 * np.pi,
        (500.0, 700.0),
    ),
    "bearing at the cut": (  # straight west of both anchors, on both sides of +-pi
        Bearing(stations=WEST, sigma=0.02),
        lambda x: np.arctan2(*(x[:2] - np.array(WEST)).T[::-1]),
        0.02,
        2 * np.pi,
        (500.0, 700.5),
    ),
    "tdoa": (TDOA(stations=STATIONS, sigma=3.0), tdoas, 3.0, np.inf, (500.0, 700.0)),
}
COV = np.array([[40.0, 9.0, 4.0, 1.0], [9.0, 30.0, 1.0, 3.0], [4, 1, 6, 0.5], [1, 3, 0.5, 5.0]])


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize("name", NONLINEAR)
def test_with_a_nonlinear_sensor_the_filter_is_the_textbook_ckf(
    rng: np.random.Generator, name: str, missing: bool
) -> None:
    sensor, h, sigma, turn, at = NONLINEAR[name]
    filter = Filter(ConstantVelocity(2, acceleration=3.0), (sensor,), linearise="cubature")
    m = len(sensor.channels)
    mean, cov = np.array([*at, 1.0, -2.0]), COV
    period, noise = np.full(m, turn), sigma**2 * np.eye(m)
    state, truth = belief(tensor(mean), tensor(cov)), np.array([*at, 4.0, -3.0])
    process = kinematics.discrete_noise(9.0 * np.eye(2), DT)
    f = kinematics.transition(2, DT)
    crossed = False  # whether the points lie on both sides of the cut
    for k in range(6):
        truth = f @ truth
        z = h(truth) + 2.0 * sigma * rng.standard_normal(m)
        z = cubature.wrapped(z, period)
        if missing:
            z[k % m] = np.nan
        state, record = one(filter, state, tensor(z), DT)
        mean, cov = cubature.ckf_predict(mean, cov, lambda x: f @ x, process)
        seen = np.array([h(x) for x in cubature.cubature_points(mean, cov)])
        crossed = crossed or bool(np.ptp(seen, axis=0).max() > period[0] / 2)
        mean, cov, e, s = cubature.ckf_update(mean, cov, h, z, noise, period)
        assert_close(state.mean, mean, 1e-11)
        assert_close(state.covariance, cov, 1e-9)
        assert_close(record.innovation, e, 1e-9)
        assert_close(record.innovation_variance, np.diag(s).copy(), 1e-9)
    assert crossed or name != "bearing at the cut"


def heading(x: np.ndarray) -> np.ndarray:
    """Speed and heading turned at a rate that depends on the speed."""
    cos, sin = np.cos(x[2]), np.sin(x[2])
    return np.array(
        [x[0] + DT * x[3] * cos, x[1] + DT * x[3] * sin, x[2] + DT * 0.05 * x[3], 0.98 * x[3]]
    )


def test_with_a_nonlinear_motion_the_filter_is_the_textbook_ckf(rng: np.random.Generator) -> None:
    def move(x: Tensor, dt: Tensor, inputs: object, values: object) -> Tensor:
        x, y, angle, speed = x.unbind(-1)
        return torch.stack(
            [x + dt * speed * angle.cos(), y + dt * speed * angle.sin(),
             angle + dt * 0.05 * speed, 0.98 * speed],
            dim=-1,
        )  # fmt: skip

    root = np.diag([0.5, 0.4, 0.02, 0.3])
    motion = FunctionMotion(("x", "y", "a", "v"), move, lambda dt, _: tensor(root))
    sensor = Range(stations=ANCHORS.tolist(), sigma=2.0)
    filter = Filter(motion, (sensor,), linearise="cubature")
    mean, cov = np.array([500.0, 700.0, 0.7, 6.0]), np.diag([9.0, 4.0, 0.2, 4.0])
    state, truth = belief(tensor(mean), tensor(cov)), np.array([502.0, 699.0, 1.0, 7.0])
    for _ in range(6):
        truth = heading(truth)
        z = ranges(truth) + 2.0 * rng.standard_normal(3)
        state, _ = one(filter, state, tensor(z), DT)
        mean, cov = cubature.ckf_predict(mean, cov, heading, root @ root)
        mean, cov, *_ = cubature.ckf_update(
            mean, cov, ranges, z, 4.0 * np.eye(3), np.full(3, np.inf)
        )
        assert_close(state.mean, mean, 1e-11)
        assert_close(state.covariance, cov, 1e-9)
    taylor = replace(filter, linearise="taylor")
    assert not torch.allclose(one(taylor, state, tensor(z), DT)[0].mean, state.mean, atol=1e-3)


LINEAR_OPTIONS = {
    "huber": {"weight": huber},
    "m-ekf": {"weight": tanh, "iterations": 3},
    "all rows": {"weight": huber, "iterations": 3, "weigh_prior": True},
    "mad": {"weight": tanh, "iterations": 2, "weigh_prior": True, "mad": True},
    "reject": {"gate": Gate("reject")},
    "reweigh": {"weight": huber, "gate": Gate("reweigh")},
    "inflate": {"gate": Gate("inflate")},
    "grouped": {"weight": huber, "scope": "all", "distance": "mahalanobis"},
    "recovery": {"gate": Gate("reject"), "recovery": Recovery("widen")},
    "recovery inflates": {"weight": huber, "recovery": Recovery("inflate", 1.0)},
    "full R": {"sigma": ((2.0, 0.5, 0.3), (0.5, 1.0, 0.2), (0.3, 0.2, 4.0)), "weight": imq},
}


@pytest.mark.parametrize("name", LINEAR_OPTIONS)
def test_on_a_linear_model_weights_and_gates_are_those_of_taylor(
    rng: np.random.Generator, name: str
) -> None:
    options = dict(LINEAR_OPTIONS[name])
    sigma = options.pop("sigma", (0.5, 1.0, 2.0))
    state = plane_belief(rng, 4)
    filters = [linear_filter(sigma, linearise=rule, **options) for rule in ("taylor", "cubature")]
    z = predicted_z(filters[0], state, DT, filters[0].prepare())
    rows = torch.stack([z + tensor(k * 4.0 * rng.standard_normal((4, 3))) for k in range(6)])
    rows[2, 1, 0] = rows[4, 2] = NAN
    found, expected = (
        run_steps(f, f.prepare(), f.start(*state[:2]), rows, torch.full((6,), DT).double())
        for f in filters
    )
    weights = torch.stack([r.weight for r in expected[1]])
    assert float(weights[rows.isfinite()].min()) < 0.9  # the row that the case is about
    for a, b in zip(found[0], expected[0], strict=True):
        assert_close(a.mean, b.mean, 1e-10)
        assert_close(a.covariance, b.covariance, 1e-9)
    for a, b in zip(found[1], expected[1], strict=True):
        for ours, theirs in ((a.weight, b.weight), (a.prior_weight, b.prior_weight)):
            assert_close(ours, theirs, 1e-9)
        assert_close(a.gate, b.gate, 1e-9)


@pytest.mark.parametrize("weigh_prior", [False, True])
def test_the_m_ekf_of_a_nonlinear_sensor_weighs_residuals_of_the_joint_gaussian(
    rng: np.random.Generator, weigh_prior: bool
) -> None:
    sensor, h, sigma, _, at = NONLINEAR["range"]
    filter = Filter(
        ConstantVelocity(2, acceleration=3.0), (sensor,), huber, iterations=3,
        weigh_prior=weigh_prior, linearise="cubature",
    )  # fmt: skip
    state = belief(tensor([*at, 1.0, -2.0]), tensor(COV))
    f = kinematics.transition(2, DT)
    mean = f @ np.array([*at, 1.0, -2.0])
    cov = f @ COV @ f.T + kinematics.discrete_noise(9.0 * np.eye(2), DT)
    e = np.array([9.0, -60.0, 5.0])
    cloud = cubature.cubature_points(mean, cov)
    seen = np.array([h(x) for x in cloud])
    z = seen.mean(0) + e
    # Columns of [whitened x; x; h], each of weight one over the eight points.
    white = np.vstack([np.eye(4), -np.eye(4)]) * 2.0
    stacked = np.hstack([white, cloud - mean, seen - seen.mean(0)]) / np.sqrt(8)
    w, prior, shift = np.ones(3), np.ones(4), np.zeros(11)
    for i in range(4):
        if i:
            w = published.huber((e - shift[8:]) / sigma, 1.345)
            if weigh_prior:
                prior = 1e-4 + (1 - 1e-4) * published.huber(-shift[:4], 1.345)
        scaled = stacked / np.sqrt(np.tile(prior, 2))[:, None]
        joint = scaled.T @ scaled
        gain = joint[:, 8:] @ np.linalg.inv(joint[8:, 8:] + np.diag(sigma**2 / w))
        shift = gain @ e
    after, record = one(filter, state, tensor(z), DT)
    assert w.min() < 0.9
    assert (prior.min() < 0.999) == weigh_prior
    assert_close(record.weight, w, 1e-8)
    assert_close(record.prior_weight, prior, 1e-8)
    assert_close(after.mean, mean + shift[4:8], 1e-11)
    assert_close(after.covariance, (joint - gain @ joint[8:])[4:8, 4:8], 1e-9)


def test_noise_common_to_channels_enters_as_a_full_r(rng: np.random.Generator) -> None:
    sensor = TDOA(stations=STATIONS, sigma=3.0, common_sigma=2.0)
    filter = tdoa_filter(sensor=sensor, linearise="cubature")
    start = belief(tensor([500.0, 700.0, 1.0, 14.0]), tensor(COV))
    z = tdoas(np.array([505.0, 710.0])) + 4.0 * rng.standard_normal(7)
    z[3] = np.nan
    found, _ = one(filter, start, tensor(z), DT)
    process = kinematics.discrete_noise(5.77**2 * np.eye(2), DT)
    f = kinematics.transition(2, DT)
    mean, cov = cubature.ckf_predict(array(start.mean), COV, lambda x: f @ x, process)
    noise = 9.0 * np.eye(7) + 4.0
    expected = cubature.ckf_update(mean, cov, tdoas, z, noise, np.full(7, np.inf))
    assert_close(found.mean, expected[0], 1e-11)
    assert_close(found.covariance, expected[1], 1e-9)


def test_a_gate_tests_the_innovation_against_the_cubature_variance() -> None:
    sensor = Range(stations=((500.0, 702.0),), sigma=0.5)  # nearer than the belief is wide
    start = belief(tensor([500.0, 700.0, 0.0, 0.0]), 16.0 * torch.eye(4).double())
    gated, taylor = (
        Filter(ConstantVelocity(2), (sensor,), gate=Gate("reject"), linearise=rule)
        for rule in ("cubature", "taylor")
    )
    mean, cov = np.array([500.0, 700.0, 0.0, 0.0]), np.diag([16.0, 16.0, 16.0, 16.0])
    center, spread, _ = cubature.ckf_moments(
        mean, cov + kinematics.discrete_noise(np.eye(2), 0.0),
        lambda x: np.array([np.hypot(x[0] - 500.0, x[1] - 702.0)]), np.full(1, np.inf),
    )  # fmt: skip
    variance = spread[0, 0] + 0.25
    threshold = number(gated.published()["gate.threshold"])
    for factor, passed in ((0.99, 1.0), (1.01, 0.0)):
        z = center + factor * np.sqrt(threshold * variance)
        _, record = one(gated, start, tensor(z), 0.0)
        assert number(record.gate) == passed
        assert number(record.innovation_variance) == pytest.approx(variance, rel=1e-10)
    variance_there = number(one(taylor, start, tensor(z), 0.0)[1].innovation_variance)
    assert abs(variance_there / variance - 1.0) > 0.1  # the rules do differ here


def test_without_any_channel_a_step_is_the_prediction(rng: np.random.Generator) -> None:
    for options in ({}, {"weight": huber, "iterations": 2, "weigh_prior": True}):
        filter = tdoa_filter(linearise="cubature", **options)
        state = plane_belief(rng, 2)
        after, record = one(filter, state, torch.full((2, 7), NAN).double(), DT)
        f = kinematics.transition(2, DT)
        process = kinematics.discrete_noise(5.77**2 * np.eye(2), DT)
        mean, cov = textbook.predict(array(state.mean), array(state.covariance), f, process)
        assert_close(after.mean, mean, 1e-13)
        assert_close(after.covariance, cov, 1e-12)
        assert not record.weight.any()


def test_a_state_that_is_known_exactly_stays_known() -> None:
    start = belief(tensor([500.0, 700.0, 1.0, 14.0]), torch.diag(tensor([25.0, 9.0, 0.0, 0.0])))
    motion = ConstantVelocity(2)
    still = FunctionMotion(
        motion.states, lambda x, dt, i, v: motion.transition(x, dt, {}, {}),
        lambda dt, _: torch.zeros(4, 1).double(),
    )  # fmt: skip
    sensor = Range(stations=ANCHORS.tolist(), sigma=2.0)
    filter = Filter(still, (sensor,), linearise="cubature")
    sigma = tensor(2.0).requires_grad_()
    constants = filter.prepare({"range.sigma": sigma})
    z = tensor(ranges(np.array([504.0, 705.0])))
    after, _ = step(filter, constants, start, Measurement(z, tensor(DT)))
    assert after.mean[2:].tolist() == [1.0, 14.0]
    assert not after.covariance[2:].any()
    # The two unknown states alone are the textbook's filter, with points sqrt(4) apart.
    root = 2.0 * np.diag([5.0, 3.0])
    mean = np.array([500.5, 707.0])
    cloud = np.vstack([mean + root, mean - root, mean, mean, mean, mean])
    seen = np.array([ranges(x) for x in cloud])
    y, x = (seen - seen.mean(0)) / np.sqrt(8), (cloud - mean) / np.sqrt(8)
    gain = x.T @ y @ np.linalg.inv(y.T @ y + 4.0 * np.eye(3))
    assert_close(after.mean[:2], mean + gain @ (array(z) - seen.mean(0)), 1e-11)
    (gradient,) = torch.autograd.grad(after.mean.sum() + after.covariance.sum(), sigma)
    assert bool(torch.isfinite(gradient))
    assert number(gradient) != 0.0


GRADCHECKED = {
    "plain": tdoa_filter(linearise="cubature"),
    "gated": tdoa_filter(linearise="cubature", weight=huber, gate=Gate("reweigh")),
    "all rows": tdoa_filter(linearise="cubature", weight=tanh, iterations=2, weigh_prior=True),
    "bearings": Filter(
        replace(pointwise(2.0), linear=False),
        (Bearing(stations=ANCHORS.tolist(), sigma=0.05),),
        imq,
        linearise="cubature",
    ),
}


@pytest.mark.parametrize("name", GRADCHECKED)
def test_a_cubature_step_passes_gradcheck(rng: np.random.Generator, name: str) -> None:
    filter = GRADCHECKED[name]
    start = belief(tensor([500.0, 700.0, 1.0, 14.0]), tensor(COV))
    z = predicted_z(filter, start, DT, filter.prepare())
    z = z + tensor(filter.sensors[0].sigma) * tensor(rng.standard_normal(len(z)))  # type: ignore[attr-defined]
    z[2] = NAN
    declared = filter.declarations
    free = [p.constraint.free(p.tensor()) for p in declared.values()]
    inputs = [start.mean, start.deviations, *free]

    def posterior(mean: Tensor, deviations: Tensor, *free: Tensor) -> tuple[Tensor, ...]:
        values = {
            n: p.constraint.physical(u) for (n, p), u in zip(declared.items(), free, strict=True)
        }
        constants = filter.prepare(values, temperature=0.5)
        before = filter.start(mean, deviations.tril())
        after, record = step(filter, constants, before, Measurement(z, tensor(DT)))
        return after.mean, after.covariance, record.weight, record.innovation_variance

    leaves = [x.clone().requires_grad_() for x in inputs]
    assert torch.autograd.gradcheck(posterior, leaves, atol=1e-5, rtol=1e-4, eps=1e-5)


@pytest.mark.parametrize("options", [{}, {"weight": tanh, "iterations": 2}], ids=["once", "m-ekf"])
def test_streaming_is_the_batch_run_with_cubature(options: dict[str, object]) -> None:
    log = airport_log(10, 3)
    assert log.start is not None
    assert COVARIANCE.shape == (4, 4)
    check(tdoa_filter(linearise="cubature", **options), log, log.start.mean)


def test_each_trajectory_of_a_batch_is_the_cubature_filter_run_alone(
    rng: np.random.Generator,
) -> None:
    filter = tdoa_filter(linearise="cubature", weight=huber)
    state = plane_belief(rng, 3)
    z = predicted_z(filter, state, DT, filter.prepare()) + 5 * tensor(rng.standard_normal((3, 7)))
    together, _ = one(filter, state, z, DT)
    for i in range(3):
        alone, _ = one(filter, Belief(state.mean[i], state.deviations[i]), z[i], DT)
        assert_close(together.mean[i], alone.mean, 1e-13)
        assert_close(together.deviations[i], alone.deviations, 1e-11)


def test_in_float32_the_covariance_stays_semidefinite_over_10_000_steps() -> None:
    motion = ConstantVelocity(1, acceleration=1e-3)
    reading = FunctionSensor(("a",), lambda x, i, v: x[..., :1] + 0.01 * x[..., :1].sin(), 1e-2)
    filter = Filter(motion, (reading,), linearise="cubature")
    constants = filter.prepare(filter.published(torch.float32))
    state = belief(torch.zeros(2), torch.diag(torch.tensor([1e6, 1e6])))
    generator = torch.Generator().manual_seed(1)
    z = 1e-2 * torch.randn(10_000, 1, generator=generator)
    beliefs, _ = run_steps(filter, constants, state, z, torch.full((10_000,), 0.1))
    covariance = torch.stack([b.covariance for b in beliefs]).double()
    assert bool(torch.isfinite(covariance).all())
    smallest = torch.linalg.eigvalsh(covariance)[:, 0]
    assert bool((smallest >= -1e-7 * covariance.amax((-1, -2))).all())
    assert bool((covariance.diagonal(dim1=-2, dim2=-1) > 0).all())
    assert number(covariance[-1, 0, 0]) < 1e-4  # it has settled


def test_an_unknown_rule_is_an_input_error() -> None:
    with pytest.raises(InputError, match="linearise: found 'unscented', expected taylor or cubat"):
        Filter(ConstantVelocity(2), (Position(),), linearise="unscented")
