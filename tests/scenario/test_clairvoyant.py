"""The filter that is told of every fault: a bound for the others."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import STATIONS, assert_close, plane_belief, predicted_z, tdoa_filter, tensor
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.filters.filter import Filter
from difffilter.filters.stepping import step
from difffilter.sensors.builtin import TDOA
from difffilter.weights.registry import huber

INNOVATION = tensor([2.0, -4.0, 40.0, 1.0, 5.5, -9.0, 14.0])
SENSORS = {
    "independent": TDOA(stations=STATIONS, sigma=3.0),
    "common": TDOA(stations=STATIONS, sigma=3.0, common_sigma=2.0),
}


def run_one(
    filter: Filter, state: Belief, innovation: Tensor, mean: Tensor, variance: Tensor
) -> tuple[Belief, Record]:
    constants = filter.prepare()
    z = predicted_z(filter, state, 0.5, constants) + innovation
    faults = {"fault.mean": mean, "fault.variance": variance}
    return step(filter, constants, state, Measurement(z, tensor(0.5), faults))


@pytest.mark.parametrize("iterations", [0, 4])
@pytest.mark.parametrize("name", list(SENSORS))
def test_a_known_fault_is_taken_off_and_its_variance_added(
    rng: np.random.Generator, name: str, iterations: int
) -> None:
    state, sensor = plane_belief(rng), SENSORS[name]
    filter = tdoa_filter(sensor=sensor, weight=huber, iterations=iterations, clairvoyant=True)
    mean, variance = tensor(rng.uniform(0, 20, 7)), tensor(rng.uniform(0, 50, 7))
    found, record = run_one(filter, state, INNOVATION + mean, mean, variance)
    sigma = tuple((9.0 + variance).sqrt().tolist())
    told = TDOA(stations=STATIONS, sigma=sigma, common_sigma=sensor.common_sigma)
    other = tdoa_filter(sensor=told, weight=huber, iterations=iterations)
    expected, expected_record = run_one(other, state, INNOVATION, mean, variance)
    assert_close(record.innovation, INNOVATION, 1e-10)
    assert_close(record.weight, expected_record.weight, 1e-10)
    assert_close(found.mean, expected.mean, 1e-12)
    assert_close(found.covariance, expected.covariance, 1e-11)


@pytest.mark.parametrize("iterations", [0, 4])
@pytest.mark.parametrize("name", list(SENSORS))
@pytest.mark.parametrize("known_mean", [0.0, 30.0, float("inf"), float("nan")])
def test_a_fault_of_infinite_variance_deletes_the_channel(
    rng: np.random.Generator, name: str, iterations: int, known_mean: float
) -> None:
    state, zero = plane_belief(rng), torch.zeros(7).double()
    mean, variance = zero.clone(), zero.clone()
    mean[[2, 5]], variance[[2, 5]] = known_mean, torch.inf
    innovation = INNOVATION.clone()
    options = {"sensor": SENSORS[name], "weight": huber, "iterations": iterations}
    found, record = run_one(
        tdoa_filter(**options, clairvoyant=True), state, innovation, mean, variance
    )
    innovation[[2, 5]] = torch.nan
    expected, _ = run_one(tdoa_filter(**options), state, innovation, mean, variance)
    assert record.present.tolist() == [i not in (2, 5) for i in range(7)]
    assert torch.equal(found.mean, expected.mean)
    assert torch.equal(found.covariance, expected.covariance)
    assert not record.innovation[[2, 5]].any()


def test_without_faults_it_is_the_plain_filter(rng: np.random.Generator) -> None:
    state, zero = plane_belief(rng, 3), torch.zeros(3, 7).double()
    innovation = INNOVATION.expand(3, 7)
    found, _ = run_one(tdoa_filter(clairvoyant=True), state, innovation, zero, zero)
    expected, _ = run_one(tdoa_filter(), state, innovation, zero, zero)
    assert torch.equal(found.mean, expected.mean)
    assert torch.equal(found.covariance, expected.covariance)


def test_a_gradient_towards_the_noise_is_finite_beside_an_infinite_variance(
    rng: np.random.Generator,
) -> None:
    state, filter = plane_belief(rng), tdoa_filter(clairvoyant=True)
    sigma = tensor(3.0).requires_grad_()
    constants = filter.prepare({"tdoa.sigma": sigma})
    variance = tensor([0.0, torch.inf, 0.0, 5.0, 0.0, torch.inf, 0.0])
    faults = {"fault.mean": 0.75 * variance, "fault.variance": variance}
    z = predicted_z(filter, state, 0.5, constants).detach() + INNOVATION
    after, record = step(filter, constants, state, Measurement(z, tensor(0.5), faults))
    loss = after.mean.sum() + after.covariance.sum() + record.nis
    (gradient,) = torch.autograd.grad(loss, sigma)
    assert bool(torch.isfinite(gradient))
    assert float(gradient) != 0.0
