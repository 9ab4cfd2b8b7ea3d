"""Snapshot estimators, Chan with a filter and the adaptive filter, against NumPy oracles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import STATIONS, array, assert_close, tdoa_filter, tensor
from oracles import adaptive, airport, localisation
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from difffilter.adaptation import InnovationScaling
from difffilter.baselines import ChanEKF, ChanLeastSquares, TaylorLeastSquares
from difffilter.core.beliefs import Belief, Measurement
from difffilter.errors import InputError
from difffilter.filters.stepping import step
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.motions.blocks import ConstantVelocity
from difffilter.parameters.parameters import Parameter
from difffilter.running.batch import run, start_belief
from difffilter.sensors.builtin import TDOA, Position, Range
from difffilter.start.fit import gauss_newton
from difffilter.weights.registry import huber

SIGMA = airport.metres(10.0)
DIFFERENCES = TDOA(stations=STATIONS, sigma=SIGMA)
COMMON = TDOA(stations=STATIONS, sigma=SIGMA, common_sigma=SIGMA)
MOTION = ConstantVelocity(2, acceleration=5.77)
NAN = torch.nan
ESTIMATORS = {
    "taylor": TaylorLeastSquares((DIFFERENCES,)),
    "chan": ChanLeastSquares((DIFFERENCES,)),
    "chan ekf": ChanEKF((DIFFERENCES,), motion=MOTION),
}
Data = dict[str, np.ndarray]


def simulated(rng: np.random.Generator, common: bool = False) -> Data:
    return airport.simulate(rng, 6, 60, 10.0, 100.0, 0.1, common)


def as_log(data: Data) -> Log:
    """Steps 1..; the prescribed start at time 0."""
    z = tensor(data["measurements"]).transpose(0, 1)[1:]
    covariance = tensor(data["initial_covariance"]).expand(z.shape[1], 4, 4)
    start = Start(tensor(data["initial_mean"]), covariance, 0.0)
    time = torch.arange(1, len(z) + 1).double() * airport.STEP
    return Log(DIFFERENCES.channels, time, z, start=start)


def by_run(x: Tensor) -> np.ndarray:
    """(T, B, ...) to the oracles' (B, T, ...)."""
    return array(x.transpose(0, 1))


def agree(track: Track, oracle: tuple[np.ndarray, np.ndarray], tolerance: float = 1e-11) -> None:
    assert_close(by_run(track.mean), oracle[0], tolerance)
    assert_close(by_run(track.covariance), oracle[1], tolerance)


@pytest.mark.parametrize("common", [False, True])
def test_taylor_is_the_oracle(rng: np.random.Generator, common: bool) -> None:
    data = simulated(rng, common)
    noise = airport.noise_covariance(10.0, common)
    z, start = data["measurements"][:, 1:], data["initial_mean"][:, None, :2]
    estimator = TaylorLeastSquares((COMMON if common else DIFFERENCES,))
    agree(estimator.estimate(as_log(data)), localisation.taylor_ls(z, start, noise))


@pytest.mark.parametrize("common", [False, True])
def test_gauss_newton_with_given_weights_is_the_oracle(
    rng: np.random.Generator, common: bool
) -> None:
    data = simulated(rng, common)
    z, w = data["measurements"][:, 1:], rng.uniform(0.05, 1.0, (6, 60, 7))
    noise = airport.noise_covariance(10.0, common)
    expected = localisation.taylor_ls(z, data["initial_mean"][:, None, :2], noise, w, 25)
    estimator = TaylorLeastSquares((COMMON if common else DIFFERENCES,))
    start = tensor(data["initial_mean"])[:, None, :2]
    constants = estimator.prepare()
    fix = gauss_newton(estimator.sensors, constants, tensor(z), {}, start, lambda s: tensor(w), 25)
    assert_close(fix.position, expected[0], 1e-11)
    assert_close(fix.deviations @ fix.deviations.mT, expected[1], 1e-11)


@pytest.mark.parametrize("tangent", [False, True])
@pytest.mark.parametrize("common", [False, True])
def test_chan_is_the_oracle(rng: np.random.Generator, common: bool, tangent: bool) -> None:
    data = simulated(rng, common)
    noise = airport.noise_covariance(10.0, common)
    estimator = ChanLeastSquares((COMMON if common else DIFFERENCES,), tangent=tangent)
    expected = localisation.chan_ls(data["measurements"][:, 1:], noise, tangent=tangent)
    agree(estimator.estimate(as_log(data)), expected)


def test_chan_needs_no_particular_origin(rng: np.random.Generator) -> None:
    """Every position of a field that does not start at the origin, exact data."""
    stations = rng.uniform(-900.0, 900.0, (6, 3)) + np.array([5e3, -2e3, 100.0])
    position = rng.uniform(-700.0, 700.0, (50, 3)) + np.array([5e3, -2e3, 100.0])
    for axes in (2, 3):
        apart = position[:, None, :axes] - stations[:, :axes]
        distance = np.linalg.norm(apart, axis=-1)
        sensor = TDOA(stations=stations[:, :axes].tolist(), sigma=1e-3, axes=axes)
        z = tensor(distance[:, 1:] - distance[:, :1])
        log = Log(sensor.channels, torch.arange(50).double(), z)
        track = ChanLeastSquares((sensor,), axes, tangent=True).estimate(log)
        assert_close(track.mean, position[:, :axes], 1e-8)


def test_chan_ekf_is_the_oracle(rng: np.random.Generator) -> None:
    data = simulated(rng)
    agree(ESTIMATORS["chan ekf"].estimate(as_log(data)), localisation.chan_ekf(data))


@pytest.mark.parametrize("common", [False, True])
def test_innovation_scaling_is_the_oracle(rng: np.random.Generator, common: bool) -> None:
    data = simulated(rng, common)
    scaling = InnovationScaling(12, (0.2, 40.0), (0.5, 5.0))
    recipe = tdoa_filter(sensor=COMMON if common else DIFFERENCES, adaptation=scaling)
    expected = adaptive.adaptive_ekf(data, 10.0, 12, (0.2, 40.0), (0.5, 5.0), common)
    agree(run(recipe, as_log(data)), expected)


@pytest.mark.parametrize("common", [False, True])
def test_innovation_scaling_goes_with_a_weighed_prior(
    rng: np.random.Generator, common: bool
) -> None:
    data = airport.simulate(rng, 3, 40, 10.0, 100.0, 0.1, common)
    wild = rng.random(data["measurements"].shape) < 0.05
    data["measurements"] = data["measurements"] + 60.0 * wild
    bounds = 12, (0.2, 40.0), (0.5, 5.0)
    recipe = tdoa_filter(
        sensor=COMMON if common else DIFFERENCES, adaptation=InnovationScaling(*bounds),
        weight=huber, iterations=3, weigh_prior=True,
    )  # fmt: skip
    track = run(recipe, as_log(data))
    assert track.record.prior_weight.min() < 0.95
    clip = float(recipe.published()["huber.k"])
    expected = adaptive.adaptive_m_ekf(
        data, lambda s: np.minimum(1.0, clip / np.maximum(np.abs(s), 1e-300)), 3, 1e-4, *bounds,
        common=common,
    )  # fmt: skip
    agree(track, expected, 1e-10)


@pytest.mark.parametrize("common", [False, True])
def test_missing_channels_are_deleted_channels(rng: np.random.Generator, common: bool) -> None:
    data = simulated(rng, common)
    log = as_log(data)
    keep = [0, 2, 3, 4, 6]
    sensor = COMMON if common else DIFFERENCES
    fewer = replace(
        sensor,
        stations=[STATIONS[0], *(STATIONS[i + 1] for i in keep)],
        channels=tuple(sensor.channels[i] for i in keep),
    )
    z = log.z.clone()
    z[..., [1, 5]] = NAN
    z[7, 2] = NAN  # a row without any
    missing, deleted = replace(log, z=z), replace(log, channels=fewer.channels, z=z[..., keep])
    for kind in (TaylorLeastSquares, ChanLeastSquares, ChanEKF):
        found = kind((sensor,)).estimate(missing)
        expected = kind((fewer,)).estimate(deleted)
        rows = torch.isfinite(expected.mean).all(-1)
        assert rows.sum() == rows.numel() - (kind is not ChanEKF)
        assert torch.equal(torch.isfinite(found.mean).all(-1), rows)
        assert_close(found.mean[rows], expected.mean[rows], 1e-11)
        assert_close(found.covariance[rows], expected.covariance[rows], 1e-11)
    scaling = InnovationScaling(12)
    found = run(tdoa_filter(sensor=sensor, adaptation=scaling), missing)
    expected = run(tdoa_filter(sensor=fewer, adaptation=scaling), deleted)
    assert_close(found.mean, expected.mean, 1e-11)
    assert_close(found.covariance, expected.covariance, 1e-11)


def test_undetermined_rows_are_nan(rng: np.random.Generator) -> None:
    log = as_log(simulated(rng))
    for name, present in (("taylor", 1), ("chan", 2)):
        z = log.z.clone()
        z[3, 1, present:] = NAN
        z[4, 0] = NAN
        track = ESTIMATORS[name].estimate(replace(log, z=z))
        unknown = torch.zeros(log.z.shape[:2], dtype=torch.bool)
        unknown[3, 1] = unknown[4, 0] = True
        assert torch.equal(torch.isnan(track.mean).all(-1), unknown)
        assert torch.equal(torch.isnan(track.deviations).all(-1).all(-1), unknown)
        assert torch.isfinite(track.mean[~unknown]).all()
    straight = TDOA(stations=[(100.0 * i, 0.0) for i in range(6)])
    ranges = np.hypot(np.arange(6) * 100.0 - 250.0, 300.0)
    line = Log(straight.channels, tensor([0.0]), tensor(ranges[1:] - ranges[0])[None])
    assert torch.isnan(ChanLeastSquares((straight,)).estimate(line).mean).all()


@pytest.mark.parametrize("name", ESTIMATORS)
def test_gradients_are_finite_beside_undetermined_rows(rng: np.random.Generator, name: str) -> None:
    log = as_log(simulated(rng))
    z = log.z.clone()
    z[3] = NAN
    z[5, 1, 1:] = NAN
    values = {k: v.requires_grad_() for k, v in ESTIMATORS[name].published().items()}
    track = ESTIMATORS[name].estimate(replace(log, z=z), values)
    fixed = torch.isfinite(track.mean)
    (track.mean[fixed].sum() + track.std[fixed].sum()).backward()
    for value in values.values():
        assert value.grad is not None
        assert torch.isfinite(value.grad).all()


@pytest.mark.parametrize("name", ESTIMATORS)
def test_batch_is_single(rng: np.random.Generator, name: str) -> None:
    log = as_log(simulated(rng))
    batch = ESTIMATORS[name].estimate(log)
    start = Start(log.start.mean[2], log.start.covariance[2], 0.0)
    single = ESTIMATORS[name].estimate(replace(log, z=log.z[:, 2], start=start))
    assert_close(single.mean, batch.mean[:, 2], 1e-12)
    assert_close(single.covariance, batch.covariance[:, 2], 1e-12)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_float32(rng: np.random.Generator, name: str) -> None:
    log = as_log(simulated(rng))
    expected = ESTIMATORS[name].estimate(log)
    found = ESTIMATORS[name].estimate(log.to(torch.float32))
    assert found.mean.dtype == found.deviations.dtype == torch.float32
    assert (found.mean - expected.mean).abs().max() < 0.05


@pytest.mark.parametrize("name", ESTIMATORS)
def test_estimator_protocol(rng: np.random.Generator, name: str) -> None:
    estimator, log = ESTIMATORS[name], as_log(simulated(rng))
    assert estimator.channels == log.channels
    assert set(estimator.published()) == set(estimator.declarations)
    assert estimator.states[:2] == ("x", "y")
    worse = Parameter("tdoa.sigma", 2 * SIGMA, estimator.declarations["tdoa.sigma"].constraint)
    other = replace(estimator, overrides={"tdoa.sigma": worse})
    by_value = estimator.estimate(log, {"tdoa.sigma": tensor(2 * SIGMA)})
    assert torch.equal(other.estimate(log).std, by_value.std)
    assert (by_value.std > estimator.estimate(log).std).all()
    with pytest.raises(InputError, match="no such parameter"):
        estimator.estimate(log, {"tdoa.typo": tensor(1.0)})
    with pytest.raises(InputError, match="found channels"):
        estimator.estimate(replace(log, channels=tuple("abcdefg")))


def test_bias_is_taken_off(rng: np.random.Generator) -> None:
    log = as_log(simulated(rng))
    late = replace(log, z=log.z + 12.5)
    for estimator in ESTIMATORS.values():
        expected, found = (
            estimator.estimate(log),
            estimator.estimate(late, {"tdoa.bias": tensor(12.5)}),
        )
        assert_close(found.mean, expected.mean, 1e-10)


def test_chan_takes_only_what_it_can() -> None:
    with_heights = TDOA(stations=[(*s, 3.0) for s in STATIONS], height=1.0)
    for sensors in ((with_heights,), (Position(),), (DIFFERENCES, Position()), ()):
        with pytest.raises(InputError, match="Chan's closed form"):
            ChanLeastSquares(sensors)
    with pytest.raises(InputError, match="expected 4 or more"):
        ChanEKF((TDOA(stations=STATIONS[:3]),))


def test_robust_weight_resists_a_wild_range(rng: np.random.Generator) -> None:
    turn = np.arange(8) * (np.pi / 4)
    anchors = np.stack([20 * np.cos(turn), 20 * np.sin(turn), np.full(8, 2.0)], axis=-1)
    sensor = Range(stations=anchors.tolist(), sigma=0.1, height=1.0)
    truth = rng.uniform(-10.0, 10.0, (40, 2))
    apart = np.concatenate([truth, np.ones((40, 1))], 1)[:, None] - anchors
    z = np.linalg.norm(apart, axis=-1) + 0.1 * rng.standard_normal((40, 8))
    z[:, 1] += 8.0
    log = Log(sensor.channels, torch.arange(40).double(), tensor(z))

    def rmse(estimator: TaylorLeastSquares) -> float:
        error = estimator.estimate(log, start=Start(torch.zeros(2).double())).mean - tensor(truth)
        return float(error.square().sum(-1).mean().sqrt())

    ordinary = TaylorLeastSquares((sensor,))
    assert rmse(replace(ordinary, weight=huber)) < 0.2 < 1.0 < rmse(ordinary)


@pytest.mark.parametrize("common", [False, True])
def test_innovation_scaling_is_pure_and_traceable(rng: np.random.Generator, common: bool) -> None:
    data = simulated(rng)
    log = as_log(data)
    recipe = tdoa_filter(sensor=COMMON if common else DIFFERENCES, adaptation=InnovationScaling(2))
    constants = recipe.prepare()
    first = start_belief(recipe, constants, log.start)
    dt = tensor(0.1)

    def twice(mean: Tensor, deviations: Tensor, memory: dict, z: Tensor) -> tuple[Belief, Belief]:
        one, _ = step(recipe, constants, Belief(mean, deviations, memory), Measurement(z[0], dt))
        two, _ = step(recipe, constants, one, Measurement(z[1], dt))
        return one, two

    arguments = (first.mean, first.deviations, dict(first.memory))
    kept = {name: value.clone() for name, value in first.memory.items()}
    traced = make_fx(twice)(*arguments, log.z[:2])
    z = log.z[2:4].clone()
    z[0, 1] = NAN
    z[1, 2, 3] = NAN
    for found, expected in zip(traced(*arguments, z), twice(*arguments, z), strict=True):
        assert_close(found.mean, expected.mean, 1e-14)
        for name, value in expected.memory.items():
            assert torch.equal(found.memory[name], value)
    for name, value in kept.items():
        assert torch.equal(first.memory[name], value)
    one, _ = twice(*arguments, z)
    for name, value in kept.items():
        assert torch.equal(one.memory[name][1], value[1])  # the row without measurements


def test_innovation_scaling_bounds_are_parameters(rng: np.random.Generator) -> None:
    recipe = tdoa_filter(sensor=DIFFERENCES, adaptation=InnovationScaling(5))
    log = as_log(simulated(rng))
    tight = {
        name: tensor([1.0 - 1e-12, 1.0]) for name in ("adaptive.bounds_r", "adaptive.bounds_q")
    }
    assert_close(run(recipe, log, tight).mean, run(tdoa_filter(sensor=DIFFERENCES), log).mean, 1e-9)
    with pytest.raises(InputError, match="window"):
        InnovationScaling(0)
