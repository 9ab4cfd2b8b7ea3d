"""Built-in sensors, the user's own, and their noise."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import torch
from helpers import STATIONS, array, assert_close, random_spd, tensor
from oracles import airport
from torch import Tensor

from difffilter.errors import InputError
from difffilter.parameters.parameters import as_number, published_values
from difffilter.parameters.values import Constants
from difffilter.sensors.builtin import TDOA, Position, Range
from difffilter.sensors.sensor import FunctionSensor, Noise, Sensor, wrap

HIGH = tuple((*station, 15.0 + i) for i, station in enumerate(STATIONS))
SENSORS: dict[str, Sensor] = {
    "position": Position(bias=(0.5, -0.5)),
    "range": Range(stations=STATIONS, bias=2.0),
    "range with heights": Range(stations=HIGH, height=3.0),
    "tdoa": TDOA(stations=STATIONS),
    "tdoa with heights": TDOA(stations=HIGH, height=3.0, bias=1.5),
    "tdoa with a common noise": TDOA(stations=STATIONS, common_sigma=2.0),
}


def constants_of(sensor: Sensor) -> Constants:
    return sensor.prepare(published_values({p.name: p for p in sensor.parameters}))


def noise_of(sensor: Sensor, constants: Constants) -> Noise:
    """The noise of a sensor that needs neither the state nor inputs."""
    return sensor.noise(torch.zeros(4).double(), {}, constants)


def jacobian(sensor: Sensor, mean: Tensor, inputs: Mapping[str, Tensor]) -> Tensor:
    """H at an unbatched mean, by differentiating the sensor's prediction."""
    constants = constants_of(sensor)
    h: Tensor = torch.func.jacfwd(lambda x: sensor.predict(x, inputs, constants))(mean)
    return h


def means(rng: np.random.Generator, *batch: int) -> Tensor:
    return tensor(np.array([500.0, 700.0, 1.0, 14.0]) + 50 * rng.standard_normal((*batch, 4)))


@pytest.mark.parametrize("name", list(SENSORS))
def test_the_written_jacobian_is_the_derivative_of_the_prediction(
    rng: np.random.Generator, name: str
) -> None:
    sensor, constants = SENSORS[name], constants_of(SENSORS[name])
    mean, deviations = means(rng), tensor(rng.standard_normal((4, 4)))
    predicted, observed = sensor.observe(mean, deviations, {}, constants)
    assert torch.equal(predicted, sensor.predict(mean, {}, constants))
    assert predicted.shape == (len(sensor.channels),)
    assert_close(observed, jacobian(sensor, mean, {}) @ deviations, 1e-13)


@pytest.mark.parametrize("name", list(SENSORS))
def test_two_leading_dimensions_are_as_many_single_predictions(
    rng: np.random.Generator, name: str
) -> None:
    sensor, constants = SENSORS[name], constants_of(SENSORS[name])
    mean, deviations = means(rng, 2, 3), tensor(rng.standard_normal((2, 3, 4, 5)))
    predicted, observed = sensor.observe(mean, deviations, {}, constants)
    for i in np.ndindex(2, 3):
        alone = sensor.observe(mean[i], deviations[i], {}, constants)
        assert_close(predicted[i], alone[0], 1e-14)
        assert_close(observed[i], alone[1], 1e-14)


def test_tdoa_is_the_range_difference_to_the_first_station(rng: np.random.Generator) -> None:
    mean = means(rng, 5)
    sensor = TDOA(stations=STATIONS)
    predicted, observed = sensor.observe(
        mean, torch.eye(4).double().expand(5, 4, 4), {}, constants_of(sensor)
    )
    position = array(mean[..., :2])
    assert_close(predicted, airport.range_differences(position), 1e-13)
    assert_close(observed[..., :2], airport.range_difference_rows(position), 1e-12)
    assert not observed[..., 2:].any()


def test_height_enters_the_distance() -> None:
    sensor = Range(stations=((0.0, 0.0, 13.0),), height=1.0)
    predicted = sensor.predict(tensor([3.0, 4.0, 0.0, 0.0]), {}, constants_of(sensor))
    assert float(predicted) == pytest.approx(13.0)


@pytest.mark.parametrize("coordinates", [2, 3])
@pytest.mark.parametrize("kind", [Range, TDOA])
def test_stations_may_come_with_each_trajectory(
    rng: np.random.Generator, kind: type[Range], coordinates: int
) -> None:
    sensor = kind(stations=STATIONS, height=2.0)
    constants, key = constants_of(sensor), f"{sensor.name}.stations"
    mean, deviations = means(rng, 3), tensor(rng.standard_normal((3, 4, 4)))
    stations = tensor(1000 * rng.standard_normal((3, len(STATIONS), coordinates)))
    predicted, observed = sensor.observe(mean, deviations, {key: stations}, constants)
    for i in range(3):
        own = kind(stations=as_number(stations[i]), height=2.0)  # type: ignore[arg-type]
        assert_close(predicted[i], own.predict(mean[i], {}, constants_of(own)), 1e-14)
        h = jacobian(sensor, mean[i], {key: stations[i]})
        assert_close(observed[i], h @ deviations[i], 1e-13)


@pytest.mark.parametrize("kind", [Range, TDOA])
def test_at_a_station_the_prediction_is_exact_and_its_gradient_finite(kind: type[Range]) -> None:
    sensor = kind(stations=STATIONS)
    constants = constants_of(sensor)
    for station in (STATIONS[0], STATIONS[3]):
        mean = tensor([*station, 1.0, 1.0])
        predicted, observed = sensor.observe(mean, torch.eye(4).double(), {}, constants)
        distance = np.linalg.norm(np.array(STATIONS) - station, axis=1)
        expected = distance if kind is Range else distance[1:] - distance[0]
        assert_close(predicted, expected, 1e-15)
        assert_close(observed, jacobian(sensor, mean, {}), 1e-13)
        assert float(observed.abs().max()) <= 2.0


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_at_a_station_the_backward_pass_stays_of_the_size_of_its_neighbours(
    dtype: torch.dtype,
) -> None:
    sensor = Range(stations=STATIONS)
    constants = Constants({name: c.to(dtype) for name, c in constants_of(sensor).items()})
    mean = torch.tensor([0.0, 0.0, 1.0, 1.0], dtype=dtype, requires_grad=True)
    _, observed = sensor.observe(mean, torch.eye(4, dtype=dtype), {}, constants)
    (gradient,) = torch.autograd.grad(observed.sum(), mean)
    # Towards another station the unit vector turns by at most 1 / distance.
    assert float(gradient.abs().max()) <= 2.0


def test_gradients_reach_the_mean_the_deviations_and_the_bias(rng: np.random.Generator) -> None:
    sensor = TDOA(stations=STATIONS)
    inputs = (means(rng), tensor(rng.standard_normal((4, 2))), tensor(1.5))

    def observe(mean: Tensor, deviations: Tensor, bias: Tensor) -> tuple[Tensor, Tensor]:
        constants = sensor.prepare({"tdoa.sigma": tensor(3.0), "tdoa.bias": bias})
        return sensor.observe(mean, deviations, {}, constants)

    for x in inputs:
        x.requires_grad_()
    assert torch.autograd.gradcheck(observe, inputs, atol=1e-6)


def ranges(state: Tensor, inputs: Mapping[str, Tensor], values: Mapping[str, Tensor]) -> Tensor:
    apart = state[..., None, :2] - tensor(STATIONS)
    return apart.square().sum(-1).sqrt()


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_a_function_sensor_equals_the_built_in_one(
    rng: np.random.Generator, batch: tuple[int, ...]
) -> None:
    built_in = Range(stations=STATIONS, sigma=2.0, bias=0.7)
    function = FunctionSensor(built_in.channels, ranges, 2.0, 0.7, name="range")
    mean, deviations = means(rng, *batch), tensor(rng.standard_normal((*batch, 4, 4)))
    a, b = constants_of(built_in), constants_of(function)
    expected = built_in.observe(mean, deviations, {}, a)
    for x, y in zip(function.observe(mean, deviations, {}, b), expected, strict=True):
        assert_close(x, y, 1e-13)
    for x, y in zip(noise_of(function, b), noise_of(built_in, a), strict=True):
        assert torch.equal(x, y)
    assert [p.name for p in function.parameters] == [p.name for p in built_in.parameters]


def test_an_angle_is_wrapped_where_the_residual_is_formed() -> None:
    z, predicted = tensor([3.1, -3.1, 0.2, np.pi]), tensor([-3.1, 3.1, 0.1, 0.0])
    expected = tensor([6.2 - 2 * np.pi, 2 * np.pi - 6.2, 0.1, -np.pi])
    assert_close(wrap(z, predicted), expected, 1e-14)
    sensor = FunctionSensor(("bearing",), ranges, residual_function=wrap)
    assert_close(sensor.residual(tensor([3.1]), tensor([-3.1])), expected[:1], 1e-13)


NOISES = {
    "one number": (3.0, 9.0 * np.eye(2)),
    "one per channel": ((3.0, 0.5), np.diag([9.0, 0.25])),
    "full": (((4.0, 1.0), (1.0, 2.0)), np.array([[4.0, 1.0], [1.0, 2.0]])),
}


@pytest.mark.parametrize("form", list(NOISES))
def test_noise_is_declared_as_a_number_a_vector_or_a_covariance(form: str) -> None:
    sigma, expected = NOISES[form]
    sensor = Position(sigma=sigma)
    independent, common, total = noise_of(sensor, constants_of(sensor))
    assert_close(torch.diag(independent) + common @ common.mT, expected, 1e-14)
    assert_close(total, np.diag(expected).copy(), 1e-14)


@pytest.mark.parametrize("full", [False, True])
def test_the_reference_station_adds_noise_common_to_all_differences(full: bool) -> None:
    own = random_spd(np.random.default_rng(1), 7) if full else 9.0 * np.eye(7)
    sigma = as_number(own.tolist()) if full else 3.0
    sensor = TDOA(stations=STATIONS, sigma=sigma, common_sigma=2.0)
    independent, common, total = noise_of(sensor, constants_of(sensor))
    expected = own + 4.0 * np.ones((7, 7))
    assert_close(torch.diag(independent) + common @ common.mT, expected, 1e-13)
    assert_close(total, np.diag(expected).copy(), 1e-13)


def test_channels_are_numbered_by_station() -> None:
    assert Range(stations=STATIONS[:2]).channels == ("range_1", "range_2")
    assert TDOA(stations=STATIONS[:3]).channels == ("tdoa_2", "tdoa_3")
    assert Position(axes=1, name="odometer").channels == ("odometer_1",)


def test_a_wrong_sensor_is_an_input_error() -> None:
    with pytest.raises(InputError, match=r"tdoa\.channels: found 1, expected 7"):
        TDOA(stations=STATIONS, channels=("one",))
    with pytest.raises(InputError, match=r"range\.stations: found \[2, 3\] coordinates"):
        Range(stations=((0.0, 0.0), (1.0, 1.0, 1.0)))
    with pytest.raises(InputError, match=r"range\.stations: found \[1\] coordinates"):
        Range(stations=((0.0,), (1.0,)))
    with pytest.raises(InputError, match=r"position\.sigma: found shape \[3\]"):
        _ = Position(sigma=(1.0, 2.0, 3.0)).parameters
    with pytest.raises(InputError, match=r"position\.bias"):
        _ = Position(bias=(1.0, 2.0, 3.0)).parameters
