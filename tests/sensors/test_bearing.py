"""Bearings: value and gradient, the cut at +-pi, stations fixed, given or on a platform."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
import pytest
import torch
from helpers import array, assert_close, number, tensor
from torch import Tensor

import difffilter as df
from difffilter.baselines import BearingLeastSquares
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.motions.blocks import ConstantVelocity
from difffilter.parameters.parameters import published_values
from difffilter.robust.gate import Gate
from difffilter.sensors.builtin import Bearing
from difffilter.start.bearings import from_bearings
from difffilter.weights.registry import igg3

SITES = ((0.0, 0.0), (300.0, -200.0), (-150.0, 400.0))
PLATFORM = ("platform_x", "platform_y")
SENSORS = {
    "at the origin": Bearing(),
    "one station": Bearing(stations=SITES[1:2]),
    "three stations": Bearing(stations=SITES, bias=(0.01, -0.02, 0.03)),
    "on a platform": Bearing(stations=SITES[1:2], platform=PLATFORM, bias=0.1),
    "several on a platform": Bearing(stations=SITES, platform=PLATFORM),
}


def constants_of(sensor: Bearing, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
    return sensor.prepare(published_values({p.name: p for p in sensor.parameters}, dtype))


def inputs_of(sensor: Bearing, *batch: int) -> dict[str, Tensor]:
    """Where the platform is, one place per entry of the batch."""
    rng = np.random.default_rng(5)
    return {name: tensor(100.0 * rng.standard_normal(batch)) for name in sensor.platform}


def bearings(state: np.ndarray, sensor: Bearing, inputs: Mapping[str, Tensor]) -> np.ndarray:
    """Bearings and bias in plain NumPy, (..., m)."""
    origin = np.zeros((*state.shape[:-1], 2))
    for i, name in enumerate(sensor.platform):
        origin[..., i] = array(inputs[name])
    apart = state[..., None, :2] - origin[..., None, :] - np.array(sensor.stations)
    return np.arctan2(apart[..., 1], apart[..., 0]) + np.array(sensor.bias)


def means(rng: np.random.Generator, *batch: int) -> Tensor:
    return tensor(np.array([500.0, 700.0, 1.0, 14.0]) + 50 * rng.standard_normal((*batch, 4)))


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
@pytest.mark.parametrize("name", SENSORS)
def test_a_bearing_is_numpys_arctan2_plus_the_bias(
    rng: np.random.Generator, name: str, batch: tuple[int, ...]
) -> None:
    sensor, constants = SENSORS[name], constants_of(SENSORS[name])
    mean, inputs = means(rng, *batch), inputs_of(sensor, *batch)
    predicted = sensor.predict(mean, inputs, constants)
    assert predicted.shape == (*batch, len(sensor.channels))
    assert_close(predicted, bearings(array(mean), sensor, inputs), 1e-14)
    observed = sensor.observe(mean, torch.eye(4).double().expand(*batch, 4, 4), inputs, constants)
    assert torch.equal(observed[0], predicted)


@pytest.mark.parametrize("name", SENSORS)
def test_the_gradient_is_that_of_finite_differences_with_a_plus_on_the_second_entry(
    rng: np.random.Generator, name: str
) -> None:
    sensor, constants = SENSORS[name], constants_of(SENSORS[name])
    mean, inputs = means(rng), inputs_of(sensor)
    _, h = sensor.observe(mean, torch.eye(4).double(), inputs, constants)
    step, state = 1e-2, array(mean)
    for i in range(4):
        shift = step * np.eye(4)[i]
        rise = bearings(state + shift, sensor, inputs) - bearings(state - shift, sensor, inputs)
        assert np.abs(array(h)[:, i] - rise / (2 * step)).max() < 1e-9
    origin = np.array([number(inputs[p]) for p in sensor.platform] or [0.0, 0.0])
    x, y = (state[:2] - origin - np.array(sensor.stations)).T
    assert_close(h[:, :2], np.stack([-y, x], -1) / (x**2 + y**2)[:, None], 1e-13)


@pytest.mark.parametrize("name", SENSORS)
def test_a_batch_is_as_many_single_observations(rng: np.random.Generator, name: str) -> None:
    sensor, constants = SENSORS[name], constants_of(SENSORS[name])
    mean, inputs = means(rng, 2, 3), inputs_of(sensor, 2, 3)
    deviations = tensor(rng.standard_normal((2, 3, 4, 5)))
    predicted, observed = sensor.observe(mean, deviations, inputs, constants)
    for i in np.ndindex(2, 3):
        own = {key: value[i] for key, value in inputs.items()}
        alone = sensor.observe(mean[i], deviations[i], own, constants)
        assert_close(predicted[i], alone[0], 1e-14)
        assert_close(observed[i], alone[1], 1e-14)


def test_gradients_reach_the_mean_the_deviations_the_bias_and_the_platform(
    rng: np.random.Generator,
) -> None:
    sensor = SENSORS["several on a platform"]
    given = (means(rng), tensor(rng.standard_normal((4, 2))), tensor(0.1), tensor([20.0, -30.0]))

    def observe(mean: Tensor, deviations: Tensor, bias: Tensor, at: Tensor) -> tuple[Tensor, ...]:
        constants = sensor.prepare({"bearing.sigma": tensor(0.1), "bearing.bias": bias})
        inputs = dict(zip(PLATFORM, at, strict=True))
        return sensor.observe(mean, deviations, inputs, constants)

    for x in given:
        x.requires_grad_()
    assert torch.autograd.gradcheck(observe, given, eps=1e-4, atol=1e-8)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_at_a_station_everything_is_finite_and_the_gradient_is_zero(dtype: torch.dtype) -> None:
    sensor = SENSORS["three stations"]
    constants = constants_of(sensor, dtype)
    mean = torch.tensor([300.0, -200.0, 1.0, 2.0], dtype=dtype, requires_grad=True)
    predicted, observed = sensor.observe(mean, torch.eye(4, dtype=dtype), {}, constants)
    assert predicted.isfinite().all()
    assert not observed[1].any()
    assert observed[0, :2].any()
    (everything,) = torch.autograd.grad(predicted.sum() + observed.sum(), mean, retain_graph=True)
    assert everything.isfinite().all()
    (own,) = torch.autograd.grad(predicted[1] + observed[1].sum(), mean)
    assert not own.any()


def test_a_filter_at_its_station_waits_for_a_prediction_elsewhere() -> None:
    filter = Filter(ConstantVelocity(2, acceleration=0.1), (Bearing(sigma=0.01),))
    prior = df.belief(torch.zeros(4).double(), torch.eye(4).double())
    row = df.Measurement(tensor([0.5]), tensor(0.0))
    after, _ = df.step(filter, filter.prepare(), prior, row)
    assert_close(after.mean, prior.mean, 1e-15)
    assert_close(after.covariance, torch.eye(4).double(), 1e-12)


def test_float32_in_float32_out() -> None:
    sensor = SENSORS["several on a platform"]
    constants = constants_of(sensor, torch.float32)
    inputs = {name: torch.tensor(7.0) for name in PLATFORM}
    mean = torch.tensor([500.0, 700.0, 0.0, 0.0])
    predicted, observed = sensor.observe(mean, torch.eye(4), inputs, constants)
    assert predicted.dtype == observed.dtype == torch.float32
    double = sensor.predict(
        mean.double(), {name: tensor(7.0) for name in PLATFORM}, constants_of(sensor)
    )
    assert_close(predicted.double(), double, 1e-6)


@pytest.mark.parametrize("turns", [-2, -1, 0, 1, 3])
def test_a_residual_is_the_short_way_round(turns: int) -> None:
    z, predicted = tensor([3.1, -3.1, 0.2]), tensor([-3.1, 3.1, 0.5])
    found = Bearing().residual(z + 2 * math.pi * turns, predicted)
    short = 2 * math.pi - 6.2
    assert_close(found, tensor([-short, short, -0.3]), 1e-12)


def rotation(angle: float) -> Tensor:
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return tensor(np.kron(np.eye(2), turn))


@pytest.mark.parametrize("recipe", ["plain", "gated", "iterated"])
@pytest.mark.parametrize("z", [math.pi - 1e-3, -math.pi + 1e-3, math.pi + 2e-3])
def test_a_step_across_the_cut_is_the_one_rotated_away(recipe: str, z: float) -> None:
    options: dict[str, object] = {
        "plain": {},
        "gated": {"weight": igg3, "gate": Gate("reweigh")},
        "iterated": {"weight": igg3, "iterations": 3},
    }[recipe]
    motion = ConstantVelocity(2, acceleration=0.1)
    filter = Filter(motion, (Bearing(sigma=2e-3),), **options)  # type: ignore[arg-type]
    mean = tensor([-1000.0, 1.0, 2.0, -3.0])
    root = tensor(np.random.default_rng(1).standard_normal((4, 4)))
    turn = rotation(-2.0)
    found = []
    for r, angle in ((torch.eye(4).double(), z), (turn, z - 2.0)):
        prior = df.belief(r @ mean, r @ (root @ root.mT) @ r.mT)
        row = df.Measurement(tensor([angle]), tensor(1.0))
        after, record = df.step(filter, filter.prepare(), prior, row)
        found.append((r.mT @ after.mean, r.mT @ after.covariance @ r, record.innovation))
    for here, there in zip(*found, strict=True):
        assert_close(here, there, 1e-9)
    assert float(found[0][2].abs()) < 0.01


@pytest.mark.parametrize("name", ["at the origin", "three stations"])
def test_a_moving_platform_is_stations_that_move(rng: np.random.Generator, name: str) -> None:
    fixed = SENSORS[name]
    riding = Bearing(stations=fixed.stations, platform=PLATFORM, bias=fixed.bias)
    mean, constants = means(rng, 4), constants_of(riding)
    at = tensor(100.0 * rng.standard_normal((4, 2)))
    inputs = {"platform_x": at[:, 0], "platform_y": at[:, 1]}
    moved = mean - torch.cat([at, torch.zeros_like(at)], dim=-1)
    expected = fixed.predict(moved, {}, constants_of(fixed))
    assert_close(riding.predict(mean, inputs, constants), expected, 1e-13)
    shared = {key: value[0] for key, value in inputs.items()}
    first = riding.predict(mean, shared, constants)
    assert_close(first[0], expected[0], 1e-13)
    assert first.shape == expected.shape


@pytest.mark.parametrize("platform", [(), PLATFORM])
def test_an_input_overrides_the_stations(
    rng: np.random.Generator, platform: tuple[str, ...]
) -> None:
    sensor = Bearing(stations=SITES, platform=platform)
    mean, stations = means(rng, 3), tensor(100 * rng.standard_normal((3, 3, 2)))
    inputs = inputs_of(sensor, 3) | {"bearing.stations": stations}
    predicted, observed = sensor.observe(
        mean, torch.eye(4).double().expand(3, 4, 4), inputs, constants_of(sensor)
    )
    for i in range(3):
        own = Bearing(stations=stations[i].tolist(), platform=platform)
        row = {name: inputs[name][i] for name in platform}
        alone = own.observe(mean[i], torch.eye(4).double(), row, constants_of(own))
        assert_close(predicted[i], alone[0], 1e-14)
        assert_close(observed[i], alone[1], 1e-13)


def platform_filter() -> Filter:
    sensor = Bearing(platform=PLATFORM, sigma=0.01)
    return Filter(ConstantVelocity(2, acceleration=0.1), (sensor,), start_sigma=10.0)


def bare_log(*inputs: str) -> df.Log:
    rows = {name: torch.zeros(4, 2).double() for name in inputs}
    time = torch.arange(4).double()
    return df.Log(("bearing",), time, tensor(np.ones((4, 2, 1))), inputs=rows)


@pytest.mark.parametrize("by", ["run", "tracker", "crossing", "first rows", "least squares"])
@pytest.mark.parametrize("given", [(), ("platform_x",)])
def test_a_missing_position_of_the_platform_is_named(by: str, given: tuple[str, ...]) -> None:
    filter, log = platform_filter(), bare_log(*given)
    start = df.Start(torch.zeros(2, 4).double())
    missing = PLATFORM[len(given)]

    def track() -> None:
        tracker = df.Tracker(filter, torch.zeros(4).double(), torch.eye(4).double())
        tracker.step([0.3], 1.0, inputs=dict.fromkeys(given, 0.0))

    calls = {
        "run": lambda: df.run(filter, log, start=start),
        "tracker": track,
        "crossing": lambda: from_bearings(filter, log, (0.0, 0.0)),
        "first rows": lambda: df.from_measurements(filter, log),
        "least squares": lambda: BearingLeastSquares(filter.sensors).estimate(log),
    }
    with pytest.raises(InputError, match=rf"found no input {missing}, expected the platform's"):
        calls[by]()


def test_channels_are_named_after_the_sensor_and_numbered_if_many() -> None:
    assert Bearing().channels == ("bearing",)
    assert Bearing(name="df", stations=SITES[:2]).channels == ("df_1", "df_2")
    assert Bearing(channels=("left",)).channels == ("left",)
    assert {p.unit for p in Bearing().parameters} == {"rad"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"axes": 3, "stations": ((0.0, 0.0, 0.0),)}, "bearing: found 3 axes, expected 2"),
        ({"axes": 1, "stations": ((0.0,),)}, "bearing: found 1 axes, expected 2"),
        ({"stations": ((0.0, 0.0, 1.0),)}, r"bearing\.stations: found \[3\] coordinates, exp"),
        ({"stations": ((0.0, 0.0), (1.0,))}, r"bearing\.stations: found \[1, 2\] coordinates"),
        ({"platform": ("x",)}, r"bearing\.platform: found 1 inputs, expected 2"),
        ({"channels": ("a", "b")}, r"bearing\.channels: found 2, expected 1"),
    ],
)
def test_what_a_bearing_cannot_be_is_refused(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Bearing(**options)  # type: ignore[arg-type]


def test_a_tracker_takes_the_platforms_position_step_by_step() -> None:
    scenario = df.load_scenario("airborne-bearing-absolute", {"world.steps": 12})
    filter = scenario.system("gated")
    assert isinstance(filter, Recipe)
    log = df.started(scenario, filter, df.simulate(scenario, 1, seed=2))
    track = df.run(filter, log)
    assert log.start is not None
    spread = torch.diag(filter.published()["start.sigma"].square())
    tracker = df.Tracker(filter, log.start.mean[0], spread)
    for k in range(12):
        inputs = {name: log.inputs[name][k, 0] for name in PLATFORM}
        tracker.step(log.z[k, 0], 1.0, inputs=inputs)
        assert_close(tracker.belief.mean.reshape(-1), track.mean[k, 0], 1e-10)


@pytest.mark.parametrize("platform", [(), PLATFORM])
@pytest.mark.parametrize("distance", [300.0, 3e4])
def test_bearings_of_several_stations_give_a_start_in_any_direction(
    rng: np.random.Generator, platform: tuple[str, ...], distance: float
) -> None:
    stations = 100.0 * np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 1.5]]) * distance / 300.0
    sensor = Bearing(stations=stations.tolist(), platform=platform, sigma=1e-4, bias=0.02)
    filter = Filter(ConstantVelocity(2, acceleration=0.1), (sensor,), start_sigma=100.0)
    angle = np.linspace(0.0, 2 * np.pi, 24, endpoint=False) + 0.03
    truth = distance * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    inputs = {name: tensor(rng.standard_normal((8, 24))) for name in platform}
    state = tensor(np.concatenate([truth, np.zeros((24, 2))], axis=-1)).expand(8, 24, 4)
    z = sensor.predict(state, inputs, filter.prepare())
    z = z + 1e-4 * tensor(rng.standard_normal(z.shape))
    log = df.Log(sensor.channels, torch.arange(8).double(), z, inputs=inputs)
    start = df.from_measurements(filter, log)
    assert float((start.mean[:, :2] - tensor(truth)).norm(dim=-1).max()) < 2e-3 * distance


def test_a_moving_platform_gives_a_start_without_a_known_velocity(
    rng: np.random.Generator,
) -> None:
    """``[start] kind = "measurements"`` with one bearing per row, of a target that stands."""
    filter = platform_filter()
    truth = tensor(rng.uniform((-1000.0, 2000.0), (1000.0, 4000.0), (6, 2)))
    time = torch.arange(10).double()
    at = torch.stack([150.0 * time, 20.0 * time.square()], dim=-1)
    apart = truth - at.unsqueeze(1)
    z = torch.atan2(apart[..., 1], apart[..., 0]).unsqueeze(-1)
    inputs = {name: at[:, i : i + 1].expand(10, 6) for i, name in enumerate(PLATFORM)}
    start = df.from_measurements(filter, df.Log(("bearing",), 0.2 * time, z, inputs=inputs))
    assert_close(start.mean[:, :2], truth, 1e-6)
