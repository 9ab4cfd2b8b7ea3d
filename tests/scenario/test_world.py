"""The simulated truth: straight lines, turns against the exact matrix, jumps, disturbances."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from helpers import array, assert_close

from difffilter.errors import InputError
from difffilter.scenario.table import Table
from difffilter.scenario.world import World, read_world
from difffilter.seeds import stream

PLANE = {"dt": 1.0, "steps": 150, "position": [2000.0, 2000.0], "velocity": [100.0, 100.0]}
#: [x, vx, y, vy], as the paper writes it, to [x, y, vx, vy].
ORDER = [0, 2, 1, 3]


def make(**keys: Any) -> World:
    return read_world(Table(PLANE | keys, "test", "world"))


def path(made: World, runs: int = 1, seed: int = 0) -> np.ndarray:
    return array(made.simulate(runs, stream(seed, "truth")))


def turn_matrix(rate: float, dt: float) -> np.ndarray:
    """F_CT of paper 4 on [x, vx, y, vy]."""
    s, c = np.sin(rate * dt), np.cos(rate * dt)
    return np.array(
        [
            [1, s / rate, 0, -(1 - c) / rate],
            [0, c, 0, -s],
            [0, (1 - c) / rate, 1, s / rate],
            [0, s, 0, c],
        ]
    )


def straight_matrix(dt: float) -> np.ndarray:
    return np.kron(np.eye(2), np.array([[1.0, dt], [0.0, 1.0]]))


@pytest.mark.parametrize("dt", [0.1, 1.0])
def test_segments_turn_as_the_exact_matrix_of_a_coordinated_turn(dt: float) -> None:
    segments = [
        {"first": 30, "last": 60, "turn_rate_deg": 3.0},
        {"first": 90, "last": 120, "turn_rate_deg": -3.0},
    ]
    found = path(make(segments=segments, dt=dt))[:, 0]
    state = np.array([2000.0, 100.0, 2000.0, 100.0])
    for k in range(1, 151):
        rate = np.radians(3.0) * (30 < k <= 60) - np.radians(3.0) * (90 < k <= 120)
        state = (turn_matrix(rate, dt) if rate else straight_matrix(dt)) @ state
        assert_close(found[k], state[ORDER], 1e-12)


def test_a_jump_of_velocity_shows_in_the_position_one_step_later() -> None:
    jump = {"step": 80, "velocity": [30.0, -10.0], "position": [0.0, 7.0]}
    found = path(make(jumps=[jump]))[:, 0]
    plain = path(make())[:, 0]
    change = found - plain
    assert not change[:80].any()
    assert change[80].tolist() == [0.0, 7.0, 30.0, -10.0]
    assert change[81].tolist() == [30.0, -3.0, 30.0, -10.0]
    assert_close(change[150], np.array([2100.0, -693.0, 30.0, -10.0]), 1e-13)


def test_a_segments_acceleration_is_exact_for_its_steps() -> None:
    found = path(make(segments=[{"first": 0, "last": 10, "acceleration": [2.0, -1.0]}]))[:, 0]
    for k in (1, 7, 10):
        expected = [2000 + 100 * k + k**2, 2000 + 100 * k - 0.5 * k**2, 100 + 2 * k, 100 - k]
        assert_close(found[k], np.array(expected, dtype=float), 1e-13)
    assert_close(found[11, 2:], np.array([120.0, 90.0]), 1e-13)


def test_segments_that_overlap_add_up() -> None:
    both = [{"first": 0, "last": 9, "acceleration": [1.0, 0.0], "turn_rate_deg": 2.0}] * 2
    once = [{"first": 0, "last": 9, "acceleration": [2.0, 0.0], "turn_rate_deg": 4.0}]
    assert_close(path(make(segments=both)), path(make(segments=once)), 1e-13)


def test_random_acceleration_is_held_for_a_step_and_drawn_anew() -> None:
    push = {"distribution": "uniform", "low": [0.0, -10.0], "high": [0.0, 10.0]}
    made = make(acceleration=push, dt=0.1, steps=30)
    found = path(made, runs=500)
    velocity = found[..., 2:]
    drawn = np.diff(velocity, axis=0) / 0.1
    assert np.abs(drawn[..., 0]).max() < 1e-9
    assert np.abs(drawn[..., 1]).max() <= 10.0 + 1e-9
    count = drawn[..., 1].size
    assert abs(drawn[..., 1].mean()) < 5 * (100 / 3 / count) ** 0.5
    assert abs(drawn[..., 1].std() / (10 / 3**0.5) - 1) < 5 / count**0.5
    assert abs((drawn[1:, :, 1] * drawn[:-1, :, 1]).mean()) < 5 * (100 / 3) / count**0.5
    moved = 0.1 * velocity[:-1] + 0.005 * drawn
    assert_close(np.diff(found[..., :2], axis=0), moved, 1e-9)


def test_a_disturbance_is_added_to_every_state() -> None:
    made = make(disturbance=[1.0, 2.0, 0.5, 0.0], steps=40)
    found = path(made, runs=500)
    added = found[1:].copy()
    added[..., :2] -= found[:-1, :, :2] + found[:-1, :, 2:]
    added[..., 2:] -= found[:-1, :, 2:]
    level = added.std((0, 1))
    assert np.abs(level[:3] / [1.0, 2.0, 0.5] - 1).max() < 5 / (2 * 40 * 500) ** 0.5
    assert level[3] < 1e-12


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_worlds_of_one_two_or_three_axes(axes: int) -> None:
    made = make(axes=axes, position=[1.0] * axes, velocity=[2.0] * axes, steps=4)
    assert made.states == ("x", "y", "z")[:axes] + ("vx", "vy", "vz")[:axes]
    assert_close(path(made, runs=2)[4], np.tile([9.0] * axes + [2.0] * axes, (2, 1)), 1e-14)


def test_every_trajectory_starts_at_the_same_state_and_goes_its_own_way() -> None:
    push = {"distribution": "normal", "mean": 0.0, "sigma": [1.0, 0.0]}
    found = path(make(acceleration=push, steps=5), runs=4)
    assert (found[0] == found[0, :1]).all()
    assert len(np.unique(found[5, :, 0])) == 4
    assert len(np.unique(found[5, :, 1])) == 1


def test_a_turn_keeps_the_speed() -> None:
    found = path(make(segments=[{"first": 0, "last": 150, "turn_rate_deg": 7.0}]))[:, 0]
    speed = np.linalg.norm(found[:, 2:], axis=-1)
    assert_close(speed, np.full(151, 20000.0**0.5), 1e-12)
    assert torch.tensor(found).isfinite().all()


def test_a_platform_moves_like_the_target_but_for_what_is_random() -> None:
    segments = [
        {"first": 30, "last": 60, "turn_rate_deg": 3.0},
        {"first": 90, "last": 120, "acceleration": [1.0, -2.0]},
    ]
    push = {"distribution": "normal", "mean": 0.0, "sigma": 1.0}
    kinematics = {"position": [-50.0, 20.0], "velocity": [150.0, -10.0], "segments": segments}
    made = make(platform=kinematics, acceleration=push, disturbance=[1.0] * 4, dt=0.5)
    alone = path(make(dt=0.5, **kinematics))[1:, 0, :2]
    assert made.platform_path().shape == (150, 2)
    assert_close(made.platform_path(), alone, 1e-13)


def test_a_platform_leaves_the_target_as_it_was() -> None:
    push = {"distribution": "normal", "mean": 0.0, "sigma": 1.0}
    carrier = {"position": [0.0, 0.0], "velocity": [150.0, 0.0]}
    with_one = path(make(platform=carrier, acceleration=push), runs=3)
    assert np.array_equal(with_one, path(make(acceleration=push), runs=3))


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_a_platforms_inputs_are_named_by_axis(axes: int) -> None:
    numbers = {"position": [1.0] * axes, "velocity": [2.0] * axes}
    made = make(axes=axes, steps=4, platform=dict(numbers), **numbers)
    assert made.platform_inputs == ("platform_x", "platform_y", "platform_z")[:axes]
    assert_close(made.platform_path()[-1], np.full(axes, 9.0), 1e-14)
    assert make().platform_inputs == ()


#: Keys of [world.platform], and what the message says.
WRONG_PLATFORMS = {
    "no position": ({"velocity": [1.0, 0.0]}, "position: found nothing, expected a list of 2 num"),
    "no velocity": ({"position": [1.0, 0.0]}, "velocity: found nothing, expected a list of 2 num"),
    "three numbers": ({"position": [1.0] * 3}, "position: found .*expected a list of 2 numbers"),
    "an unknown key": (
        {"position": [0.0] * 2, "velocity": [0.0] * 2, "jumps": []}, "jumps: unknown key",
    ),
    "a segment that ends": (
        {"position": [0.0] * 2, "velocity": [0.0] * 2, "segments": [{"first": 5, "last": 5}]},
        r"segments\[0\]\.last: found 5, expected a step after first = 5",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG_PLATFORMS)
def test_what_is_wrong_in_a_platform_is_named(name: str) -> None:
    keys, message = WRONG_PLATFORMS[name]
    with pytest.raises(InputError, match=rf"^test: world\.platform\.{message}"):
        make(platform=keys)
