"""Motion models against textbook matrices."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import array, assert_close, random_spd, tensor
from oracles import kinematics
from torch import Tensor

from difffilter import Fusion, Mixture
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.motions.blocks import ConstantVelocity, CoordinatedTurn, FunctionMotion, Motion
from difffilter.parameters.parameters import Parameter, as_number, published_values
from difffilter.parameters.values import Constants
from difffilter.scenario.scenario import load_scenario

ORACLES = {"discrete": kinematics.discrete_noise, "continuous": kinematics.continuous_noise}
DTS = (0.0, 0.1, 1.0, 7.5)


def constants_of(motion: ConstantVelocity | FunctionMotion) -> Constants:
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


def noise_of(motion: Motion, dt: Tensor, constants: Constants) -> Tensor:
    """The noise of a motion that needs neither the state nor inputs."""
    return motion.noise(torch.zeros(len(motion.states)).double(), dt, {}, constants)


@pytest.mark.parametrize("dt", DTS)
@pytest.mark.parametrize("axes", [1, 2, 3])
@pytest.mark.parametrize("form", ["scale", "diagonal", "full"])
@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_the_process_noise_is_the_textbook_q(kind: str, form: str, axes: int, dt: float) -> None:
    value, covariance = acceleration(form, axes)
    motion = ConstantVelocity(axes, kind, value)  # type: ignore[arg-type]
    deviations = noise_of(motion, tensor(dt), constants_of(motion))
    expected = ORACLES[kind](covariance, dt)
    assert_close(deviations @ deviations.mT, expected, 1e-13)


@pytest.mark.parametrize("kind", ["discrete", "continuous"])
def test_no_time_means_no_noise_and_no_motion(kind: str) -> None:
    motion = ConstantVelocity(2, kind, 3.0)
    constants, zero = constants_of(motion), tensor(0.0)
    mean, deviations = tensor([1.0, 2.0, 3.0, 4.0]), torch.eye(4).double()
    assert not noise_of(motion, zero, constants).any()
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
    noise = noise_of(motion, dt, constants)
    moved = motion.transition(mean, dt, {}, constants)
    spread = motion.propagate(mean, deviations, dt, {}, constants)
    for i in np.ndindex(2, 3):
        assert_close(noise[i], noise_of(motion, dt[i], constants), 1e-15)
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
        deviations = noise_of(motion, tensor([0.0, 0.4]), constants)
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
    assert_close(noise_of(function, dt, b), noise_of(built_in, dt, a), 1e-15)


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


@pytest.mark.parametrize("value", [1.5, (0.5, 1.0, 2.0, 3.0)])
def test_noise_of_the_states_is_diagonal_whatever_the_interval(value: object) -> None:
    motion = ConstantVelocity(2, "state", value)  # type: ignore[arg-type]
    (parameter,) = motion.parameters
    assert (parameter.name, parameter.unit) == ("motion.state_sigma", "m, m/s")
    constants = constants_of(motion)
    dt = tensor([0.0, 0.3, 7.0])
    deviations = noise_of(motion, dt, constants)
    expected = np.diag(np.broadcast_to(value, 4) ** 2)
    assert_close(deviations @ deviations.mT, np.tile(expected, (3, 1, 1)), 1e-14)
    assert_close(noise_of(motion, dt[0], constants), np.sqrt(expected), 1e-14)
    mean = tensor([1.0, 2.0, 3.0, 4.0])
    expected = kinematics.transition(2, 0.3) @ array(mean)
    assert_close(motion.transition(mean, dt[1], {}, constants), expected, 1e-15)
    free = parameter.constraint.free(parameter.tensor()).requires_grad_()

    def covariance(free: Tensor) -> Tensor:
        own = motion.prepare({parameter.name: parameter.constraint.physical(free)})
        deviations = noise_of(motion, dt, own)
        return deviations @ deviations.mT

    assert torch.autograd.gradcheck(covariance, free)


def test_noise_of_the_states_is_named_by_state_and_of_a_shape() -> None:
    (parameter,) = ConstantVelocity(2, "state", (1.0, 2.0, 3.0, 4.0)).parameters
    assert parameter.entries() == [f"motion.state_sigma.{s}" for s in ("x", "y", "vx", "vy")]
    for wrong in ((1.0, 2.0), ((1.0, 0.0), (0.0, 1.0))):
        with pytest.raises(InputError, match=r"motion.state_sigma: found shape .*or 4 numbers"):
            _ = ConstantVelocity(2, "state", wrong).parameters


def turn_matrix(w: float, t: float) -> np.ndarray:
    """Paper 4, with the states as [x, y, vx, vy]."""
    s, c = np.sin(w * t), np.cos(w * t)
    return np.array(
        [[1, 0, s / w, -(1 - c) / w], [0, 1, (1 - c) / w, s / w], [0, 0, c, -s], [0, 0, s, c]]
    )


@pytest.mark.parametrize("dt", [0.1, 1.0, 30.0])
@pytest.mark.parametrize("rate", [0.05, -0.3, 3.0])
def test_a_coordinated_turn_is_the_papers_matrix(
    rng: np.random.Generator, rate: float, dt: float
) -> None:
    motion = CoordinatedTurn(2, "state", 1.0, turn_rate=rate)
    constants = constants_of(motion)
    f = turn_matrix(rate, dt)
    mean, deviations = rng.standard_normal((3, 4)), rng.standard_normal((3, 4, 5))
    found = motion.transition(tensor(mean), tensor(dt), {}, constants)
    assert_close(found, mean @ f.T, 1e-13)
    found = motion.propagate(tensor(mean), tensor(deviations), tensor(dt), {}, constants)
    assert_close(found, f @ deviations, 1e-13)


def test_a_coordinated_turn_integrates_a_velocity_that_rotates() -> None:
    rate, dt, steps = 0.2, 3.0, 4000
    position, velocity = np.array([1.0, -2.0]), np.array([8.0, 3.0])
    angles = (np.arange(steps) + 0.5) * rate * dt / steps
    cos, sin = np.cos(angles), np.sin(angles)
    x, y = velocity
    path = np.stack([cos * x - sin * y, sin * x + cos * y], axis=-1).sum(0) * dt / steps
    motion = CoordinatedTurn(2, turn_rate=rate)
    mean = tensor([*position, *velocity])
    found = motion.transition(mean, tensor(dt), {}, constants_of(motion))
    assert_close(found[:2], position + path, 1e-7)
    assert float(found[2:].norm()) == pytest.approx(float(np.hypot(*velocity)))


def test_at_rate_zero_a_turn_is_straight_and_so_is_its_limit(rng: np.random.Generator) -> None:
    mean, dt = tensor(rng.standard_normal((5, 4))), tensor(2.5)
    straight = ConstantVelocity(2).transition(mean, dt, {}, {})
    for rate in (0.0, 1e-12, -1e-12):
        motion = CoordinatedTurn(2, turn_rate=rate)
        assert_close(motion.transition(mean, dt, {}, constants_of(motion)), straight, 1e-11)


@pytest.mark.parametrize("value", [0.0, 1e-5, 0.3])
def test_a_turn_passes_gradcheck_towards_its_rate_also_at_zero(value: float) -> None:
    motion = CoordinatedTurn(2)
    inputs = (
        tensor(value).requires_grad_(),
        tensor([1.0, 2.0, 30.0, -7.0]).requires_grad_(),
        tensor(1.7).requires_grad_(),
    )

    def move(rate: Tensor, mean: Tensor, dt: Tensor) -> Tensor:
        return motion.transition(mean, dt, {}, Constants({"motion.turn_rate": rate}))

    assert torch.autograd.gradcheck(move, inputs)
    (gradient,) = torch.autograd.grad(move(*inputs)[2:].sum(), inputs[0])
    assert float(gradient) != 0.0


def test_a_turn_rate_of_the_log_overrides_the_parameter() -> None:
    motion = CoordinatedTurn(2, turn_rate=0.7)
    constants, mean = constants_of(motion), tensor([[1.0, 2.0, 3.0, 4.0]] * 3)
    rates = np.array([0.1, -0.2, 0.4])
    inputs = {"turn_rate": tensor(rates)}
    found = motion.transition(mean, tensor([1.0, 2.0, 3.0]), inputs, constants)
    for i, dt in enumerate((1.0, 2.0, 3.0)):
        assert_close(found[i], turn_matrix(rates[i], dt) @ array(mean[i]), 1e-13)
    spread = motion.propagate(
        mean,
        torch.eye(4).double().expand(3, 4, 4),
        tensor(1.0),
        inputs,
        Constants({"motion.turn_rate": tensor(9.0)}),
    )
    for i, rate in enumerate(rates):
        assert_close(spread[i], turn_matrix(rate, 1.0), 1e-13)


def test_a_coordinated_turn_is_in_the_plane() -> None:
    with pytest.raises(InputError, match="motion axes: found 3, expected 2 for a coordinated turn"):
        CoordinatedTurn(3)


def test_a_scenario_names_its_motion_model() -> None:
    scenario = load_scenario(
        "manoeuvre-fusion-1",
        {
            "motion.model": "coordinated-turn",
            "parameters.motion.turn_rate": {"value": 0.05, "unit": "rad/s"},
        },
    )
    for name, system in scenario.systems.items():
        built = scenario.system(name)
        if isinstance(built, Mixture):  # its modes say their own
            continue
        assert isinstance(built, Filter | Fusion), system
        assert isinstance(built.motion, CoordinatedTurn)
        assert float(built.published()["motion.turn_rate"]) == 0.05
    plain = load_scenario("manoeuvre-fusion-1").system("srckf")
    assert isinstance(plain, Recipe)
    assert type(plain.motion) is ConstantVelocity
