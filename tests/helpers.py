"""Small helpers of the tests: random problems, conversions, a loop over steps."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from oracles import kinematics, textbook
from oracles.airport import RECEIVERS
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record, belief
from difffilter.filters.filter import Filter
from difffilter.filters.stepping import step
from difffilter.motions.blocks import ConstantVelocity
from difffilter.parameters.parameters import Values
from difffilter.sensors.builtin import TDOA
from difffilter.sensors.sensor import FunctionSensor

Array = NDArray[np.float64]

STATIONS = tuple(map(tuple, RECEIVERS.tolist()))


def tensor(array: Array | float | Sequence[float]) -> Tensor:
    """float64 tensor."""
    return torch.tensor(np.asarray(array, dtype=float))


def array(value: Tensor) -> Array:
    """NumPy copy, detached."""
    return value.detach().numpy().copy()


def number(value: Tensor) -> float:
    """A tensor of one entry as a number, detached."""
    return float(value.detach())


def assert_close(found: Tensor | Array, expected: Tensor | Array, tolerance: float) -> None:
    """Agreement relative to the largest expected entry; NaN never agrees."""
    found, expected = (array(x) if isinstance(x, Tensor) else x for x in (found, expected))
    assert found.shape == expected.shape
    scale = max(float(np.abs(expected).max(initial=0.0)), 1e-300)
    error = np.abs(found - expected).max(initial=0.0)
    assert error <= tolerance * scale, f"error {error:.3g}, largest expected entry {scale:.3g}"


def random_spd(rng: np.random.Generator, n: int, *batch: int) -> Array:
    """Well-conditioned random covariances (*batch, n, n)."""
    root = rng.standard_normal((*batch, n, n))
    return root @ np.swapaxes(root, -1, -2) + 0.5 * np.eye(n)


def plane_belief(rng: np.random.Generator, *batch: int) -> Belief:
    """A correlated belief on [x, y, vx, vy] about a taxiing aircraft."""
    mean = np.array([500.0, 700.0, 1.0, 14.0]) + rng.standard_normal((*batch, 4))
    return belief(tensor(mean), tensor(random_spd(rng, 4, *batch)))


def tdoa_filter(**options: object) -> Filter:
    """Constant velocity and seven range differences of 3 m; options of the filter."""
    sensor = options.pop("sensor", None) or TDOA(stations=STATIONS, sigma=3.0)
    motion = ConstantVelocity(2, acceleration=5.77)
    return Filter(motion, (sensor,), **options)  # type: ignore[arg-type]


def predicted_z(filter: Filter, prior: Belief, dt: float, constants: Values) -> Tensor:
    """Noise-free measurement of the predicted mean."""
    mean = filter.motion.transition(prior.mean, tensor(dt), {}, constants)
    return torch.cat([sensor.predict(mean, {}, constants) for sensor in filter.sensors], dim=-1)


def run_steps(
    filter: Filter, constants: Values, state: Belief, z: Tensor, dt: Tensor
) -> tuple[list[Belief], list[Record]]:
    """Beliefs and records over z (steps, ..., m) and dt (steps,)."""
    beliefs, records = [], []
    for row, interval in zip(z, dt, strict=True):
        state, record = step(filter, constants, state, Measurement(row, interval))
        beliefs.append(state)
        records.append(record)
    return beliefs, records


MOTION = ConstantVelocity(2, acceleration=0.8)
MATRIX = np.random.default_rng(3).standard_normal((3, 4))


def linear_filter(sigma: object = (0.5, 1.0, 2.0), **options: object) -> Filter:
    """Three channels z = H x + noise with a fixed matrix H."""
    h = tensor(MATRIX)
    sensor = FunctionSensor(
        ("a", "b", "c"),
        lambda x, inputs, values: (h @ x.unsqueeze(-1)).squeeze(-1),
        sigma,  # type: ignore[arg-type]
        name="linear",
    )
    return Filter(MOTION, (sensor,), **options)  # type: ignore[arg-type]


def textbook_predict(state: Belief, dt: float) -> tuple[Array, Array]:
    """Predicted mean and covariance of :func:`linear_filter` in textbook form."""
    process = kinematics.discrete_noise(0.8**2 * np.eye(2), dt)
    return textbook.predict(
        array(state.mean), array(state.covariance), kinematics.transition(2, dt), process
    )


def one(filter: Filter, state: Belief, z: Tensor, dt: float = 0.5) -> tuple[Belief, Record]:
    """One step at the declared values."""
    return step(filter, filter.prepare(), state, Measurement(z, tensor(dt)))
