"""Motions and sensors whose noise sees state and inputs, and states on a manifold."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from attitude_cases import attitude
from helpers import array, assert_close, tensor
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.stepping import step
from difffilter.motions import quaternion
from difffilter.motions.blocks import ConstantVelocity, CoordinatedTurn, FunctionMotion
from difffilter.sensors.builtin import Position
from difffilter.sensors.sensor import FunctionSensor

GRAVITY = np.array([0.0, 0.0, 9.81])
NORTH = np.array([0.4, 0.0, 0.9])
GYRO, ACCELEROMETER, COMPASS = 0.05, 0.2, 0.03


def still(state: Tensor, dt: Tensor, inputs: object, values: object) -> Tensor:
    return state.clone()


def attitude_filter(linearise: str = "taylor") -> Filter:
    """Quaternion, gyro as an input, gravity and the magnetic field seen in the body's axes."""
    fields = {"a": GRAVITY, "m": NORTH}
    return attitude(fields, GYRO, (ACCELEROMETER, COMPASS), linearise)


def cross(v: np.ndarray) -> np.ndarray:
    x, y, z = v
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def rotation(v: np.ndarray) -> np.ndarray:
    """Rodrigues."""
    angle = np.linalg.norm(v)
    k = cross(v / angle) if angle else np.zeros((3, 3))
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def right_jacobian(v: np.ndarray) -> np.ndarray:
    """exp(v + d) = exp(v) exp(J d), to first order in d."""
    angle, k = np.linalg.norm(v), cross(v)
    a, b = (1 - np.cos(angle)) / angle**2, (angle - np.sin(angle)) / angle**3
    return np.eye(3) - a * k + b * k @ k


def textbook_step(
    c: np.ndarray, p: np.ndarray, rate: np.ndarray, dt: float, z: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Multiplicative EKF on rotation matrices C (body to reference), errors in body axes."""
    turn = rotation(rate * dt)
    c, p = c @ turn, turn.T @ p @ turn + GYRO**2 * dt * np.eye(3)
    predicted = np.concatenate([c.T @ GRAVITY, c.T @ NORTH])
    h = np.vstack([cross(c.T @ GRAVITY), cross(c.T @ NORTH)])
    r = np.diag([ACCELEROMETER**2] * 3 + [COMPASS**2] * 3)
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
    shift = gain @ (z - predicted)
    p = (np.eye(3) - gain @ h) @ p
    reset = right_jacobian(shift)
    return c @ rotation(shift), reset @ p @ reset.T


@pytest.mark.parametrize("linearise", ["taylor", "cubature"])
def test_an_attitude_filter_is_the_multiplicative_ekf(
    rng: np.random.Generator, linearise: str
) -> None:
    f = attitude_filter(linearise)
    constants = f.prepare()
    c, p = rotation(np.array([0.3, -0.2, 2.0])), 0.2 * np.eye(3)
    q = quaternion.exponential(tensor([0.3, -0.2, 2.0]))
    truth = c @ rotation(np.array([0.3, 0.2, -0.4]))
    belief = f.start(q, tensor(np.linalg.cholesky(p)))
    for _ in range(30):
        rate, dt = rng.standard_normal(3), 0.1
        truth = truth @ rotation(rate * dt)
        z = np.concatenate([truth.T @ GRAVITY, truth.T @ NORTH]) + 0.1 * rng.standard_normal(6)
        c, p = textbook_step(c, p, rate, dt, z)
        inputs = {f"w{axis}": tensor(w) for axis, w in zip("xyz", rate, strict=True)}
        belief, _ = step(f, constants, belief, Measurement(tensor(z), tensor(dt), inputs))
    columns = [quaternion.rotate(belief.mean, tensor(axis)) for axis in np.eye(3)]
    found = array(torch.stack(columns, dim=-1))
    assert belief.deviations.shape == (3, 3)
    if linearise == "taylor":
        assert_close(found, c, 1e-12)
        assert_close(belief.covariance, p, 1e-9)
    else:  # another linearisation of the same model, near the truth the same filter
        error = np.arccos((np.trace(found.T @ truth) - 1) / 2)
        assert error < 0.1
        assert_close(belief.covariance, p, 0.05)


def test_quaternion_shifts_invert_each_other(rng: np.random.Generator) -> None:
    q = quaternion.exponential(tensor(rng.standard_normal((5, 3))))
    shift = tensor(rng.standard_normal((5, 3)))
    shift[0] = 0.0
    moved = quaternion.retract(q, shift)
    assert_close(quaternion.local(q, moved), shift, 1e-13)
    assert_close(quaternion.local(q, -moved), shift, 1e-13)
    zero = torch.zeros(3).double()
    slope = torch.func.jacfwd(lambda s: quaternion.local(q[0], quaternion.retract(q[0], s)))(zero)
    assert_close(slope, np.eye(3), 1e-14)
    v = tensor(rng.standard_normal((5, 3)))
    assert_close(quaternion.rotate_back(q, quaternion.rotate(q, v)), v, 1e-13)
    c = rotation(np.array([0.3, -0.2, 2.0]))
    turned = quaternion.rotate(quaternion.exponential(tensor([0.3, -0.2, 2.0])), v)
    assert_close(turned, array(v) @ c.T, 1e-13)


def test_process_noise_may_enter_along_the_heading() -> None:
    def noise(state: Tensor, dt: Tensor, inputs: dict[str, Tensor], values: object) -> Tensor:
        along = torch.stack([state[..., 2].cos(), state[..., 2].sin()], dim=-1)
        along = torch.nn.functional.pad(along, (0, 1))
        return (inputs["slip"] * along).unsqueeze(-1)

    motion = FunctionMotion(("x", "y", "heading"), still, noise, kinds={"heading": "angle"})
    f = Filter(motion, (Position(sigma=1.0),))
    mean, zero = tensor([1.0, 2.0, 0.6]), torch.zeros(3, 3).double()
    row = Measurement(tensor([np.nan, np.nan]), tensor(1.0), {"slip": tensor(2.0)})
    after, _ = step(f, f.prepare(), Belief(mean, zero), row)
    along = np.array([np.cos(0.6), np.sin(0.6), 0.0])
    assert_close(after.covariance, 4.0 * np.outer(along, along), 1e-14)
    assert motion.kinds == {"x": "position", "y": "position", "heading": "angle"}


@pytest.mark.parametrize("full", [False, True])
def test_measurement_noise_may_follow_a_column_of_the_log(full: bool) -> None:
    sigma = ((4.0, 1.0), (1.0, 9.0)) if full else (2.0, 3.0)
    sensor = FunctionSensor(
        ("e", "n"),
        lambda s, i, v: s[..., :2],
        sigma=sigma,
        noise_function=lambda s, i, v: i["hdop"].unsqueeze(-1) * torch.ones(2).double(),
    )
    f = Filter(ConstantVelocity(acceleration=1.0), (sensor,))
    row = Measurement(tensor([[5.0, 7.0]] * 2), tensor(0.0), {"hdop": tensor([1.5, 4.0])})
    prior = np.diag([25.0, 16.0, 1.0, 1.0])
    deviations = tensor(np.sqrt(prior)).expand(2, 4, 4)
    start = f.start(torch.zeros(2, 4).double(), deviations)
    after, _ = step(f, f.prepare(), start, row)
    for i, hdop in enumerate((1.5, 4.0)):
        r = np.array(sigma) if full else np.diag(np.square(sigma))
        h = np.eye(2, 4)
        gain = prior @ h.T @ np.linalg.inv(h @ prior @ h.T + hdop**2 * r)
        assert_close(after.mean[i], gain @ [5.0, 7.0], 1e-13)
        assert_close(after.covariance[i], (np.eye(4) - gain @ h) @ prior, 1e-13)


def test_what_states_are_is_told_by_the_motion() -> None:
    assert set(ConstantVelocity(2, names=("east", "north")).kinds.items()) == {
        ("east", "position"), ("north", "position"), ("veast", "velocity"), ("vnorth", "velocity"),
    }  # fmt: skip
    turn = CoordinatedTurn()
    assert turn.flat
    assert turn.tangent == turn.states
    a, b = tensor([1.0, 2.0, 3.0, 4.0]), tensor([1.5, 2.0, 3.0, 5.0])
    assert torch.equal(turn.retract(a, turn.local(a, b)), b)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kinds": {"speed": "fast"}}, "expected a state .* and one of position, velocity"),
        ({"kinds": {"height": "position"}}, "found height = 'position'"),
        ({"retract_function": torch.add}, "both or neither"),
        ({"tangent": ("a",)}, "expected retract and local"),
    ],
)
def test_a_motion_that_contradicts_itself_is_refused(
    options: dict[str, object], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        FunctionMotion(("x", "speed"), still, lambda dt, v: dt, **options)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"expected .state, dt, inputs, values. or .dt, values."):
        FunctionMotion(("x", "speed"), still, lambda dt: dt)
