"""Motion models against textbook matrices."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import array, assert_close, random_spd, tensor
from oracles import kinematics
from torch import Tensor

from difffilter.errors import InputError
from difffilter.motion import ConstantVelocity, FunctionMotion
from difffilter.parameters import Parameter, as_number, published_values

ORACLES = {"discrete": kinematics.discrete_noise, "continuous": kinematics.continuous_noise}
DTS = (0.0, 0.1, 1.0, 7.5)


def constants_of(motion: ConstantVelocity | FunctionMotion) -> dict[str, Tensor]:
    return motion.prepare(published_values({p.name: p for p in motion.parameters}))


def acceleration(form: str, axes: int) -> tuple[object, np.ndarray]:
    """The parameter in one of its three forms, and the covariance that it stands for."""
    if form == "scale":
        return 1.7, 1.7**2 * np.eye(axes)
    if form == "diagonal":
        sigma = np.array([0.5, 2.0, 3.0])[:axes]
        return tuple(sigma.tolist()), np.diag(sigma**2)
    full = random_spd(np.random.default_rng(axes), axes)
    return as_number(full.tolist()), full


@pytest.mark.parametrize("dt", DTS)
@pytest.mark.parametrize("axes", [1, 2, 3])
@pytest.mark.parametrize("form", ["scale", "diagonal", "full"])
@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_the_process_noise_is_the_textbook_q(kind: str, form: str, axes: int, dt: float) -> None:
    value, covariance = acceleration(form, axes)
    motion = ConstantVelocity(axes, kind, value)  # type: ignore[arg-type]
    deviations = motion.noise(tensor(dt), constants_of(motion))
    expected = ORACLES[kind](covariance, dt)
    assert_close(deviations @ deviations.mT, expected, 1e-13)


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_no_time_means_no_noise_and_no_motion(kind: str) -> None:
    motion = ConstantVelocity(2, kind, 3.0)
    constants, zero = constants_of(motion), tensor(0.0)
    mean, deviations = tensor([1.0, 2.0, 3.0, 4.0]), torch.eye(4).double()
    assert not motion.noise(zero, constants).any()
    assert torch.equal(motion.transition(mean, zero, {}, constants), mean)
    assert torch.equal(motion.propagate(mean, deviations, zero, {}, constants), deviations)


@pytest.mark.parametrize("dt", DTS)
@pytest.mark.parametrize("axes", [1, 2, 3])
def test_the_transition_is_the_textbook_f(rng: np.random.Generator, axes: int, dt: float) -> None:
    motion = ConstantVelocity(axes)
    mean, deviations = rng.standard_normal(2 * axes), rng.standard_normal((2 * axes, 5))
    f = kinematics.transition(axes, dt)
    moved = motion.transition(tensor(mean), tensor(dt), {}, {})
    assert_close(moved, f @ mean, 1e-15)
    moved = motion.propagate(tensor(mean), tensor(deviations), tensor(dt), {}, {})
    assert_close(moved, f @ deviations, 1e-15)


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_every_trajectory_may_have_its_own_interval(rng: np.random.Generator, kind: str) -> None:
    motion = ConstantVelocity(2, kind, (0.5, 2.0))
    constants = constants_of(motion)
    dt = tensor(rng.uniform(0.0, 2.0, (2, 3)))
    mean, deviations = (tensor(rng.standard_normal(s)) for s in ((2, 3, 4), (2, 3, 4, 4)))
    noise = motion.noise(dt, constants)
    moved = motion.transition(mean, dt, {}, constants)
    spread = motion.propagate(mean, deviations, dt, {}, constants)
    for i in np.ndindex(2, 3):
        assert_close(noise[i], motion.noise(dt[i], constants), 1e-15)
        assert_close(moved[i], motion.transition(mean[i], dt[i], {}, constants), 1e-15)
        alone = motion.propagate(mean[i], deviations[i], dt[i], {}, constants)
        assert_close(spread[i], alone, 1e-15)


@pytest.mark.parametrize("form", ["scale", "diagonal", "full"])
@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_the_noise_covariance_passes_gradcheck_towards_the_acceleration(
    kind: str, form: str
) -> None:
    value, _ = acceleration(form, 2)
    motion = ConstantVelocity(2, kind, value)  # type: ignore[arg-type]
    (parameter,) = motion.parameters
    free = parameter.constraint.free(parameter.tensor()).requires_grad_()

    def covariance(free: Tensor) -> Tensor:
        constants = motion.prepare({parameter.name: parameter.constraint.physical(free)})
        deviations = motion.noise(tensor([0.0, 0.4]), constants)
        return deviations @ deviations.mT

    assert torch.autograd.gradcheck(covariance, free)


def test_states_and_units_are_named() -> None:
    assert ConstantVelocity(2).states == ("x", "y", "vx", "vy")
    assert ConstantVelocity(1, names=("east",)).states == ("east", "veast")
    assert ConstantVelocity(2).parameters[0].unit == "m/s^2"
    assert ConstantVelocity(2, "continuous").parameters[0].unit == "m/s^1.5"
    diagonal = ConstantVelocity(2, acceleration=(1.0, 2.0)).parameters[0]
    assert diagonal.entries() == ["motion.acceleration.x", "motion.acceleration.y"]


def test_a_wrong_motion_model_is_an_input_error() -> None:
    with pytest.raises(InputError, match="motion noise: found 'white'"):
        ConstantVelocity(2, "white")
    with pytest.raises(InputError, match="motion axes: found 0"):
        ConstantVelocity(0)
    with pytest.raises(InputError, match="motion axes: found 4"):
        ConstantVelocity(4)
    with pytest.raises(InputError, match=r"motion.acceleration: found shape \[3\]"):
        _ = ConstantVelocity(2, acceleration=(1.0, 2.0, 3.0)).parameters


def as_function(motion: ConstantVelocity) -> FunctionMotion:
    """The same model, written as a user writes one."""

    def move(state: Tensor, dt: Tensor, inputs: object, values: object) -> Tensor:
        position, velocity = state[..., :2], state[..., 2:]
        return torch.cat([position + dt.unsqueeze(-1) * velocity, velocity], dim=-1)

    def noise(dt: Tensor, values: dict[str, Tensor]) -> Tensor:
        q = values["motion.acceleration"] * torch.eye(2).double()
        step = dt[..., None, None]
        return torch.cat([step.square() / 2 * q, step * q], dim=-2)

    return FunctionMotion(motion.states, move, noise, motion.parameters)


@pytest.mark.parametrize("batch", [(), (3,), (2, 3)])
def test_a_function_motion_equals_the_built_in_model(
    rng: np.random.Generator, batch: tuple[int, ...]
) -> None:
    built_in = ConstantVelocity(2, acceleration=1.3)
    function = as_function(built_in)
    mean, deviations = (tensor(rng.standard_normal((*batch, 4, *k))) for k in ((), (4,)))
    dt = tensor(rng.uniform(0.1, 2.0, batch))
    a, b = constants_of(built_in), constants_of(function)
    assert function.states == built_in.states
    moved = function.transition(mean, dt, {}, b)
    assert_close(moved, built_in.transition(mean, dt, {}, a), 1e-15)
    moved = function.propagate(mean, deviations, dt, {}, b)
    assert_close(moved, built_in.propagate(mean, deviations, dt, {}, a), 1e-15)
    assert_close(function.noise(dt, b), built_in.noise(dt, a), 1e-15)


def turn(state: Tensor, dt: Tensor, inputs: dict[str, Tensor], values: dict[str, Tensor]) -> Tensor:
    """A nonlinear model with a known input and a parameter."""
    heading, speed = state[..., 2], state[..., 3]
    rate = values["turn.gain"] * inputs["command"]
    x = state[..., 0] + dt * speed * torch.cos(heading)
    y = state[..., 1] + dt * speed * torch.sin(heading)
    return torch.stack([x, y, heading + dt * rate * speed, speed.clone()], dim=-1)


def test_a_nonlinear_function_motion_is_linearised_at_the_mean(rng: np.random.Generator) -> None:
    gain = Parameter("turn.gain", 0.3)
    names = ("x", "y", "heading", "speed")
    motion = FunctionMotion(names, turn, lambda dt, _: torch.eye(4), (gain,))
    constants = constants_of(motion)
    mean, deviations = tensor([1.0, 2.0, 0.4, 5.0]), tensor(rng.standard_normal((4, 3)))
    dt, inputs = tensor(0.5), {"command": tensor(1.2)}
    found = array(motion.propagate(mean, deviations, dt, inputs, constants))
    expected = np.zeros((4, 3))
    for j in range(3):
        step = 1e-6 * deviations[:, j]
        up, down = (motion.transition(mean + s * step, dt, inputs, constants) for s in (1, -1))
        expected[:, j] = array(up - down) / 2e-6
    assert_close(found, expected, 1e-8)


def test_gradients_pass_through_the_jacobian_of_a_function_motion() -> None:
    motion = FunctionMotion(("a", "b", "c", "d"), turn, lambda dt, _: torch.eye(4))
    inputs = (
        tensor([1.0, 2.0, 0.4, 5.0]).requires_grad_(),
        (torch.eye(4, 2).double() + 0.3).requires_grad_(),
        tensor(0.3).requires_grad_(),
    )

    def propagate(mean: Tensor, deviations: Tensor, gain: Tensor) -> Tensor:
        command = {"command": tensor(1.2)}
        return motion.propagate(mean, deviations, tensor(0.5), command, {"turn.gain": gain})

    assert torch.autograd.gradcheck(propagate, inputs)
