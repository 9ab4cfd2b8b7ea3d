"""The M-EKF step against explicit whitened regression (paper 3, eqs. 15-27)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers import array, assert_close, plane_belief, predicted_z, run_steps, tdoa_filter, tensor
from oracles import airport, kinematics, regression, textbook
from oracles import weights as published
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record, belief
from difffilter.filters.filter import Filter
from difffilter.filters.stepping import step
from difffilter.sensors.builtin import TDOA
from difffilter.weights.registry import WEIGHTS

FLOOR = 1e-4
WEIGH: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "huber": published.huber,
    "tanh": published.tanh,
    "igg3": published.igg3,
    "imq": lambda s: published.imq(s, 3.0),
}
#: Rows that are weighed, and whether the residuals are divided by their spread.
MODES = {
    "measurement rows": {},
    "measurement rows + MAD": {"mad": True},
    "all rows": {"weigh_prior": True},
    "all rows + MAD": {"weigh_prior": True, "mad": True},
}
INNOVATION = np.array([2.0, -4.0, 40.0, 1.0, 5.5, -9.0, 14.0])


def problem(
    state: Belief, innovation: np.ndarray, dt: float = 0.5
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Predicted mean and covariance, and H there, in textbook form."""
    process = kinematics.discrete_noise(5.77**2 * np.eye(2), dt)
    mean, cov = textbook.predict(
        array(state.mean), array(state.covariance), kinematics.transition(2, dt), process
    )
    rows = np.zeros((len(innovation), 4))
    rows[:, :2] = airport.range_difference_rows(mean[:2])
    return mean, cov, rows


def run_one(
    filter: Filter, state: Belief, innovation: np.ndarray, dt: float = 0.5
) -> tuple[Belief, Record]:
    constants = filter.prepare()
    z = predicted_z(filter, state, dt, constants) + tensor(innovation)
    return step(filter, constants, state, Measurement(z, tensor(dt)))


def oracle(
    name: str, mode: str, state: Belief, innovation: np.ndarray, iterations: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Posterior mean, covariance, and all weights by explicit regression."""
    mean, cov, rows = problem(state, innovation)
    here = np.isfinite(innovation)
    options = MODES[mode]
    shift, posterior, weights = regression.m_estimate(
        cov,
        innovation[here],
        rows[here],
        9.0 * np.eye(int(here.sum())),
        WEIGH[name],
        iterations,
        FLOOR if "weigh_prior" in options else None,
        "mad" in options,
    )
    return mean + shift, posterior, weights


@pytest.mark.parametrize("iterations", [1, 5])
@pytest.mark.parametrize("mode", list(MODES))
@pytest.mark.parametrize("name", list(WEIGH))
def test_the_step_is_the_reweighted_regression(
    rng: np.random.Generator, name: str, mode: str, iterations: int
) -> None:
    state = plane_belief(rng)
    filter = tdoa_filter(weight=WEIGHTS[name], iterations=iterations, **MODES[mode])
    after, record = run_one(filter, state, INNOVATION)
    mean, cov, weights = oracle(name, mode, state, INNOVATION, iterations)
    assert_close(record.weight, weights[4:], 1e-9)
    assert_close(record.prior_weight, weights[:4], 1e-9)
    assert_close(after.mean, mean, 1e-11)
    assert_close(after.covariance, cov, 1e-9)


@pytest.mark.parametrize("missing", [[2], [0, 6], [1, 2, 3]])
@pytest.mark.parametrize("mode", list(MODES))
def test_missing_channels_are_rows_left_out_of_the_regression(
    rng: np.random.Generator, mode: str, missing: list[int]
) -> None:
    state = plane_belief(rng)
    innovation = INNOVATION.copy()
    innovation[missing] = np.nan
    filter = tdoa_filter(weight=WEIGHTS["huber"], iterations=5, **MODES[mode])
    after, record = run_one(filter, state, innovation)
    mean, cov, weights = oracle("huber", mode, state, innovation, 5)
    assert not record.weight[missing].any()
    assert_close(array(record.weight)[np.isfinite(innovation)], weights[4:], 1e-9)
    assert_close(after.mean, mean, 1e-11)
    assert_close(after.covariance, cov, 1e-9)


@pytest.mark.parametrize("mode", ["measurement rows", "all rows"])
@pytest.mark.parametrize("name", ["huber", "imq"])
def test_many_iterations_reach_the_weighted_least_squares_solution(
    rng: np.random.Generator, name: str, mode: str
) -> None:
    state = plane_belief(rng)
    filter = tdoa_filter(weight=WEIGHTS[name], iterations=150, **MODES[mode])
    after, record = run_one(filter, state, INNOVATION)
    mean, cov, rows = problem(state, INNOVATION)
    design, target = regression.whitened(cov, INNOVATION, rows, 9.0 * np.eye(7))
    # At the solution the weights are those of its own residuals.
    residual = target - design @ (array(after.mean) - mean)
    weights = WEIGH[name](residual)
    weights[:4] = FLOOR + (1 - FLOOR) * weights[:4] if mode == "all rows" else 1.0
    assert_close(record.weight, weights[4:], 1e-8)
    shift, posterior = regression.weighted_ls(design, target, weights)
    assert_close(after.mean, mean + shift, 1e-10)
    assert_close(after.covariance, posterior, 1e-7)


@pytest.mark.parametrize("iterations", [1, 4])
@pytest.mark.parametrize("form", ["common", "full"])
def test_correlated_noise_keeps_its_covariances_under_reweighting(
    rng: np.random.Generator, form: str, iterations: int
) -> None:
    noise = 9.0 * np.eye(7) + 4.0
    sigma = noise.tolist() if form == "full" else 3.0
    sensor = TDOA(
        stations=airport.RECEIVERS.tolist(),
        sigma=sigma,
        common_sigma=2.0 if form == "common" else None,
    )
    filter = tdoa_filter(sensor=sensor, weight=WEIGHTS["huber"], iterations=iterations)
    state = plane_belief(rng)
    after, record = run_one(filter, state, INNOVATION)
    mean, cov, rows = problem(state, INNOVATION)
    shift, posterior = textbook.kalman_update(np.zeros(4), cov, INNOVATION, rows, noise)
    for _ in range(iterations):
        w = published.huber((INNOVATION - rows @ shift) / np.sqrt(13.0))
        weighted = regression.weighted_noise(noise, w)
        shift, posterior = textbook.kalman_update(np.zeros(4), cov, INNOVATION, rows, weighted)
    assert_close(record.weight, w, 1e-10)
    assert_close(after.mean, mean + shift, 1e-12)
    assert_close(after.covariance, posterior, 1e-11)


@pytest.mark.parametrize("mode", list(MODES))
def test_a_singular_start_gives_a_finite_step_and_gradient(mode: str) -> None:
    state = belief(tensor([500.0, 0.0, 700.0, 0.0]), torch.diag(tensor([1e6, 0.0, 1e6, 0.0])))
    filter = tdoa_filter(weight=WEIGHTS["tanh"], iterations=3, **MODES[mode])
    values = {k: v.requires_grad_() for k, v in filter.published().items()}
    constants = filter.prepare(values, temperature=0.1)
    z = predicted_z(filter, state, 0.0, constants).detach() + tensor(INNOVATION)
    after, _ = step(filter, constants, state, Measurement(z, tensor(0.0)))
    loss = after.mean.square().sum() + after.deviations.square().sum()
    for gradient in torch.autograd.grad(loss, list(values.values()), allow_unused=True):
        assert gradient is not None
        assert bool(torch.isfinite(gradient).all())


@pytest.mark.parametrize("name", ["ekf", "m-ekf", "clairvoyant"])
def test_the_airport_trajectories_agree_with_the_textbook_filters(name: str) -> None:
    data = airport.simulate(np.random.default_rng(5), 3, 40, n_l_ns=100.0, p=0.2)
    sigma = airport.metres(10.0)
    sensor = TDOA(stations=airport.RECEIVERS.tolist(), sigma=sigma)
    options = {"m-ekf": {"weight": WEIGHTS["tanh"], "iterations": 5}}.get(name, {})
    filter = tdoa_filter(sensor=sensor, clairvoyant=name == "clairvoyant", **options)
    state = belief(tensor(data["initial_mean"]), tensor(data["initial_covariance"]))
    z = tensor(data["measurements"][:, 1:]).transpose(0, 1)
    if name == "clairvoyant":
        expected = textbook.clairvoyant(data, 100.0)
        means, covs = _clairvoyant_run(filter, state, z, data["nlos"][:, 1:])
    else:
        run = {"ekf": textbook.ekf, "m-ekf": lambda d: textbook.m_ekf(d, published.tanh)}[name]
        expected = run(data)
        beliefs, _ = run_steps(filter, filter.prepare(), state, z, tensor([0.1] * 40))
        means = torch.stack([b.mean for b in beliefs], 1)
        covs = torch.stack([b.covariance for b in beliefs], 1)
    assert_close(means, expected[0], 1e-10)
    assert_close(covs, expected[1], 1e-8)


def _clairvoyant_run(
    filter: Filter, state: Belief, z: Tensor, nlos: np.ndarray
) -> tuple[Tensor, Tensor]:
    delay, means, covs = airport.metres(100.0), [], []
    for k, row in enumerate(z):
        flag = tensor(nlos[:, k].astype(float))
        faults = {
            "fault.mean": 0.75 * delay * flag,
            "fault.variance": (0.5 * delay) ** 2 / 12 * flag,
        }
        state, _ = step(filter, filter.prepare(), state, Measurement(row, tensor(0.1), faults))
        means.append(state.mean)
        covs.append(state.covariance)
    return torch.stack(means, 1), torch.stack(covs, 1)
