"""One step against the textbook filter: linear models, weights, several sensors."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import (
    MATRIX,
    MOTION,
    STATIONS,
    array,
    assert_close,
    linear_filter,
    one,
    plane_belief,
    random_spd,
    run_steps,
    tensor,
    textbook_predict,
)
from oracles import airport, kinematics, textbook
from oracles import weights as published
from oracles.regression import weighted_noise

from difffilter.core.beliefs import Belief, Measurement, belief
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.prediction import predict
from difffilter.filters.stepping import step
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter, as_number
from difffilter.sensors.builtin import TDOA, Position, Range
from difffilter.weights.registry import WEIGHTS, Weight, huber


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_prediction_is_the_textbook_one(rng: np.random.Generator, batch: tuple[int, ...]) -> None:
    state = plane_belief(rng, *batch)
    filter = linear_filter()
    z = torch.zeros(*batch, 3).double()
    mean, deviations, *_ = predict(filter, filter.prepare(), state, Measurement(z, tensor(0.5)))
    expected = textbook_predict(state, 0.5)
    assert_close(mean, expected[0], 1e-14)
    assert_close(deviations @ deviations.mT, expected[1], 1e-13)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_on_a_linear_model_the_filter_is_the_kalman_filter(
    rng: np.random.Generator, batch: tuple[int, ...]
) -> None:
    state, filter = plane_belief(rng, *batch), linear_filter()
    dts = rng.uniform(0.1, 2.0, 12)
    dts[4] = 0.0
    z = 500 * rng.standard_normal((12, *batch, 3))
    beliefs, _ = run_steps(filter, filter.prepare(), state, tensor(z), tensor(dts))
    mean, cov = array(state.mean), array(state.covariance)
    noise = np.diag([0.25, 1.0, 4.0])
    for k in range(12):
        process = kinematics.discrete_noise(0.8**2 * np.eye(2), dts[k])
        mean, cov = textbook.predict(mean, cov, kinematics.transition(2, dts[k]), process)
        mean, cov = textbook.kalman_update(mean, cov, z[k] - mean @ MATRIX.T, MATRIX, noise)
        assert_close(beliefs[k].mean, mean, 1e-12)
        assert_close(beliefs[k].covariance, cov, 1e-10)


def test_each_trajectory_of_a_batch_is_the_filter_run_alone(rng: np.random.Generator) -> None:
    state, filter = plane_belief(rng, 2, 3), linear_filter(weight=huber)
    z, dt = tensor(500 * rng.standard_normal((2, 3, 3))), tensor(rng.uniform(0, 1, (2, 3)))
    constants = filter.prepare()
    together, record = step(filter, constants, state, Measurement(z, dt))
    for i in np.ndindex(2, 3):
        alone = Belief(state.mean[i], state.deviations[i])
        alone, alone_record = step(filter, constants, alone, Measurement(z[i], dt[i]))
        assert_close(together.mean[i], alone.mean, 1e-14)
        assert_close(together.deviations[i], alone.deviations, 1e-14)
        assert_close(record.weight[i], alone_record.weight, 1e-14)
        assert float(record.nis[i]) == pytest.approx(float(alone_record.nis), rel=1e-12)


def test_the_start_with_exact_velocity_is_followed_exactly() -> None:
    state = belief(torch.zeros(4).double(), torch.diag(tensor([1e6, 0.0, 1e6, 0.0])))
    after, _ = one(linear_filter(), state, tensor([100.0, -50.0, 20.0]))
    mean, cov = textbook_predict(state, 0.5)
    noise = np.diag([0.25, 1.0, 4.0])
    innovation = np.array([100.0, -50.0, 20.0]) - MATRIX @ mean
    mean, cov = textbook.kalman_update(mean, cov, innovation, MATRIX, noise)
    assert_close(after.mean, mean, 1e-9)
    assert_close(after.covariance, cov, 1e-9)


@pytest.mark.parametrize("standardise", ["innovation", "noise"])
@pytest.mark.parametrize("name", ["huber", "igg3", "tanh", "imq"])
@pytest.mark.parametrize("form", ["independent", "full"])
def test_a_robust_weight_is_that_of_the_standardised_innovation(
    rng: np.random.Generator, name: str, standardise: str, form: str
) -> None:
    noise = random_spd(rng, 3) if form == "full" else np.diag([0.25, 1.0, 4.0])
    sigma = as_number(noise.tolist()) if form == "full" else (0.5, 1.0, 2.0)
    weight = WEIGHTS[name]
    filter = linear_filter(sigma, weight=weight, standardise=standardise)
    state = plane_belief(rng)
    mean, cov = textbook_predict(state, 0.5)
    variance = np.diag(noise).copy()
    if standardise == "innovation":
        variance += np.diag(MATRIX @ cov @ MATRIX.T)
    s = np.array([0.4, -1.9, 3.1])
    innovation = s * np.sqrt(variance)
    after, record = one(filter, state, tensor(MATRIX @ mean + innovation))
    numbers = np.ravel(weight.parameters[0].tensor().tolist())
    w = getattr(published, name)(s, *numbers)
    mean, cov = textbook.kalman_update(mean, cov, innovation, MATRIX, weighted_noise(noise, w))
    assert_close(record.standardised, s, 1e-10)
    assert_close(record.weight, w, 1e-10)
    assert_close(after.mean, mean, 1e-12)
    assert_close(after.covariance, cov, 1e-10)


def test_weights_of_one_are_the_plain_filter(rng: np.random.Generator) -> None:
    ones = Weight("ones", lambda s, constants, temperature: 0 * s + 1)
    state, z = plane_belief(rng), tensor([1.0, 2.0, 3.0])
    plain, weighted = linear_filter(), linear_filter(weight=ones)
    for filter in (weighted, linear_filter(weight=ones, iterations=3)):
        assert_close(one(filter, state, z)[0].mean, one(plain, state, z)[0].mean, 1e-14)
        found = one(filter, state, z)[0].covariance
        assert_close(found, one(plain, state, z)[0].covariance, 1e-13)


@pytest.mark.parametrize("common", [None, 2.0])
def test_several_sensors_are_one_joint_update(
    rng: np.random.Generator, common: float | None
) -> None:
    tdoa = TDOA(stations=STATIONS, sigma=3.0, common_sigma=common)
    sensors = (Position(sigma=((4.0, 1.0), (1.0, 2.0))), tdoa, Range(stations=STATIONS, sigma=5.0))
    filter = Filter(MOTION, sensors)
    state = plane_belief(rng)
    mean, cov = textbook_predict(state, 0.5)
    innovation = 4 * rng.standard_normal(17)
    noise = np.zeros((17, 17))
    noise[:2, :2] = [[4.0, 1.0], [1.0, 2.0]]
    noise[2:9, 2:9] = 9.0 * np.eye(7) + (common or 0.0) ** 2
    noise[9:, 9:] = 25.0 * np.eye(8)
    constants = filter.prepare()
    at = tensor(mean)
    zs = [s.predict(at, {}, constants) for s in sensors]
    rows = [array(s.observe(at, torch.eye(4).double(), {}, constants)[1]) for s in sensors]
    after, record = one(filter, state, torch.cat(zs) + tensor(innovation))
    h = np.vstack(rows)
    assert_close(rows[1][:, :2], airport.range_difference_rows(mean[:2]), 1e-12)
    expected = textbook.kalman_update(mean, cov, innovation, h, noise)
    assert_close(after.mean, expected[0], 1e-12)
    assert_close(after.covariance, expected[1], 1e-12)
    s = h @ cov @ h.T + noise
    assert_close(record.innovation_variance, np.diag(s).copy(), 1e-12)
    assert float(record.nis) == pytest.approx(innovation @ np.linalg.solve(s, innovation))


def test_a_wrong_recipe_is_an_input_error() -> None:
    with pytest.raises(InputError, match="standardise: found 'sigma'"):
        linear_filter(standardise="sigma")
    with pytest.raises(InputError, match="iterations: found -1"):
        linear_filter(iterations=-1)
    with pytest.raises(InputError, match="weigh_prior and mad"):
        linear_filter(mad=True)
    with pytest.raises(InputError, match="found a name twice"):
        Filter(MOTION, (Position(), Position()))
    with pytest.raises(InputError, match=r"no\.such: no such parameter"):
        linear_filter(overrides={"no.such": Parameter("no.such", 1.0, Positive())})
    with pytest.raises(InputError, match=r"no\.such: no such parameter"):
        linear_filter().prepare({"no.such": tensor(1.0)})


def test_given_values_are_what_the_step_uses(rng: np.random.Generator) -> None:
    state, z = plane_belief(rng), tensor([450.0, -300.0, 1.0])
    filter = linear_filter()
    sigma = tensor([2.0, 0.7, 1.0])
    constants = filter.prepare({"linear.sigma": sigma})
    found, _ = step(filter, constants, state, Measurement(z, tensor(0.5)))
    for same in (linear_filter((2.0, 0.7, 1.0)), filter.with_values({"linear.sigma": sigma})):
        assert torch.equal(found.mean, one(same, state, z)[0].mean)
    assert not torch.equal(found.mean, one(filter, state, z)[0].mean)
