"""Crossing bearings: the start from the first ones, and least squares over all of them."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from helpers import Array, array, assert_close, tensor
from oracles import bearing as oracle

import difffilter as df
from difffilter.baselines import BearingLeastSquares
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, stack_logs
from difffilter.motions.blocks import ConstantVelocity
from difffilter.sensors.builtin import Bearing, Position
from difffilter.start.bearings import from_bearings

NAN = torch.nan
PLATFORM = ("platform_x", "platform_y")
VELOCITY = (-600.0, 0.0)
FILTER = df.load_scenario("airborne-bearing").system("ekf")
assert isinstance(FILTER, Recipe)


@cache
def noisy(outliers: bool = False) -> Array:
    """Bearings (200, 20) of the oracle's world."""
    return oracle.simulate(20, np.random.default_rng(3), outliers=outliers)["bearings"]


def log_of(z: Array, time: object = None) -> Log:
    at = torch.arange(1, len(z) + 1).double() if time is None else tensor(time)  # type: ignore[arg-type]
    return Log(("bearing",), at, tensor(z).unsqueeze(-1))


def platform_filter(sensor: Bearing | None = None) -> Filter:
    made = sensor or Bearing(platform=PLATFORM, sigma=1e-5)
    return Filter(ConstantVelocity(2, acceleration=0.1), (made,), start_sigma=100.0)


def winding(rng: np.random.Generator, runs: int, rows: int = 30) -> tuple[Log, Array]:
    """A platform that winds about, exact bearings of moving targets, their states at row 0."""
    time = np.cumsum(rng.uniform(0.5, 1.5, rows))
    s = time - time[0]
    path = np.stack([100.0 * s, 800.0 * np.sin(0.3 * s)], axis=-1)[:, None]
    state = np.concatenate(
        [[2000.0, 5000.0] + 500 * rng.standard_normal((runs, 2)), np.tile([3.0, -8.0], (runs, 1))],
        axis=-1,
    )
    apart = state[:, :2] + s[:, None, None] * state[:, 2:] - path
    z = tensor(np.arctan2(apart[..., 1], apart[..., 0])).unsqueeze(-1)
    known = tensor(np.broadcast_to(path, (rows, runs, 2)).copy())
    inputs = dict(zip(PLATFORM, known.unbind(-1), strict=True))
    return Log(("bearing",), tensor(time), z, inputs=inputs), state


@pytest.mark.parametrize("rows", [2, 6, 30])
@pytest.mark.parametrize("lead", [0.0, 2.5])
def test_without_noise_the_start_is_exact(rng: np.random.Generator, rows: int, lead: float) -> None:
    log, state = winding(rng, 5)
    start = from_bearings(platform_filter(), log, (3.0, -8.0), rows=rows, lead=lead)
    expected = state.copy()
    expected[:, :2] -= lead * state[:, 2:]
    assert_close(start.mean, expected, 1e-8)
    assert start.covariance is None
    assert start.time == (float(log.time[0]) - lead if lead else None)


def test_several_stations_cross_in_one_row() -> None:
    sensor = Bearing(stations=((0.0, 0.0), (100.0, 0.0), (0.0, 50.0)), sigma=0.01)
    filter = platform_filter(sensor)
    truth = tensor([[30.0, 70.0, 0.0, 0.0], [-40.0, 10.0, 0.0, 0.0]])
    z = sensor.predict(truth, {}, filter.prepare()).expand(2, 2, 3).clone()
    z[1] = NAN
    log = Log(sensor.channels, tensor([0.0, 1.0]), z)
    assert_close(from_bearings(filter, log, (0.0, 0.0)).mean, truth, 1e-12)


def test_a_known_bias_is_taken_off(rng: np.random.Generator) -> None:
    log, state = winding(rng, 3)
    biased = replace(log, z=log.z + 0.02)
    filter = platform_filter()
    values = {"bearing.bias": tensor(0.02)}
    found = from_bearings(filter, biased, (3.0, -8.0), values).mean
    assert_close(found, state, 1e-8)
    wrong = from_bearings(filter, biased, (3.0, -8.0)).mean
    assert float((wrong - found).norm(dim=-1).min()) > 50.0


def test_the_start_is_the_oracles() -> None:
    z = noisy()
    start = from_bearings(FILTER, log_of(z), VELOCITY, lead=1.0)
    assert_close(start.mean, oracle.initial(z), 1e-9)
    assert start.time == 0.0
    other = from_bearings(FILTER, log_of(z), VELOCITY, rows=9, lead=1.0)
    assert_close(other.mean, oracle.initial(z, 9), 1e-9)


def test_a_single_trajectory_is_one_of_the_batch() -> None:
    z = noisy()
    batch = from_bearings(FILTER, log_of(z), VELOCITY, lead=1.0)
    log = log_of(z)
    alone = from_bearings(FILTER, replace(log, z=log.z[:, 7]), VELOCITY, lead=1.0)
    assert alone.mean.shape == (4,)
    assert_close(alone.mean, batch.mean[7], 1e-12)


def test_rows_without_a_bearing_are_passed_over() -> None:
    """The first six rows that have one count, at their own times."""
    z = noisy().copy()
    z[[0, 2, 3, 7], 4] = np.nan
    found = from_bearings(FILTER, log_of(z), VELOCITY, lead=1.0).mean
    rows = [1, 4, 5, 6, 8, 9]
    normal = np.stack([np.sin(z[rows, 4]), -np.cos(z[rows, 4])], axis=-1)
    moved = np.outer(np.array(rows) + 1.0, VELOCITY)
    position = np.linalg.lstsq(normal, -(normal * moved).sum(-1), rcond=None)[0]
    assert_close(found[4, :2], position, 1e-9)
    assert_close(found[5], oracle.initial(noisy())[5], 1e-9)


def test_padding_of_shorter_logs_is_nothing(rng: np.random.Generator) -> None:
    log, state = winding(rng, 2)
    singles = [
        replace(
            log.rows(0, rows),
            z=log.z[:rows, i],
            inputs={name: value[:rows, i] for name, value in log.inputs.items()},
        )
        for i, rows in ((0, 30), (1, 4))
    ]
    stacked = stack_logs(singles)
    start = from_bearings(platform_filter(), stacked, (3.0, -8.0), lead=1.0)
    expected = state[:, :2] - state[:, 2:]
    assert_close(start.mean[:, :2], expected, 1e-8)


def test_the_papers_singular_covariance_stays_exactly_singular() -> None:
    """P0 = diag(1e6, 0, 1e6, 0): zeros stay zeros where nothing adds to them."""
    z = noisy()[:30]
    log = replace(log_of(z), start=from_bearings(FILTER, log_of(z), VELOCITY, lead=1.0))
    assert FILTER.published()["start.sigma"].tolist() == [1000.0, 1000.0, 0.0, 0.0]
    quiet = {"motion.acceleration": tensor(1e-200)}  # its square is zero
    track = df.run(FILTER, log, quiet)
    assert not track.covariance[:, :, 2:].any()
    assert not track.covariance[..., 2:].any()
    assert torch.equal(track.mean[..., 2:], tensor(VELOCITY).expand(30, 20, 2))
    assert (track.std[-1, :, :2] < 500.0).all()
    moving = df.run(FILTER, log)
    assert torch.isfinite(moving.mean).all()
    assert (moving.std[0, :, 2:] > 0.0).all()


@pytest.mark.parametrize("names", [(), ("first", "second", "third")])
@pytest.mark.parametrize(
    ("bearings", "what"),
    [("parallel", "do not cross"), ("behind", "cross behind the observer"), ("one", "do not cross"),
     ("none", "do not cross")],
)  # fmt: skip
def test_bearings_that_give_no_position_name_their_trajectory(
    rng: np.random.Generator, names: tuple[str, ...], bearings: str, what: str
) -> None:
    log, _ = winding(rng, 3)
    z = log.z.clone()
    if bearings == "parallel":
        z[:, 1] = 0.4
    elif bearings == "behind":
        z[:, 1] += np.pi
    else:
        z[1 if bearings == "one" else 0 :, 1] = NAN
    who = names[1] if names else 1
    with pytest.raises(InputError, match=rf"^start: trajectory {who}: its first 6 bearings {what}"):
        from_bearings(platform_filter(), replace(log, z=z, names=names), (3.0, -8.0))


def test_parallel_bearings_in_float32_do_not_cross_either(rng: np.random.Generator) -> None:
    log, state = winding(rng, 3)
    sound = from_bearings(platform_filter(), log.to(torch.float32), (3.0, -8.0), rows=20)
    assert sound.mean.dtype == torch.float32
    assert_close(sound.mean[:, :2].double(), state[:, :2], 0.01)
    for angle in (0.0, 0.1, 0.4, 1.0, 2.0):
        z = torch.full_like(log.z, angle)
        with pytest.raises(InputError, match="do not cross"):
            from_bearings(platform_filter(), replace(log, z=z).to(torch.float32), (3.0, -8.0))


def test_logs_that_begin_at_different_times_need_no_lead(rng: np.random.Generator) -> None:
    log, state = winding(rng, 2)
    late = replace(log, time=torch.stack([log.time, log.time + 5.0], dim=-1))
    assert_close(from_bearings(platform_filter(), late, (3.0, -8.0)).mean, state, 1e-8)
    with pytest.raises(InputError, match="found logs that begin at different times"):
        from_bearings(platform_filter(), late, (3.0, -8.0), lead=1.0)


def test_other_sensors_and_too_few_rows_are_refused(rng: np.random.Generator) -> None:
    log, _ = winding(rng, 2)
    with pytest.raises(InputError, match="rows: found 1, expected 2 or more"):
        from_bearings(platform_filter(), log, (3.0, -8.0), rows=1)
    motion = ConstantVelocity(2, acceleration=0.1)
    both = Filter(motion, (Bearing(), Position()))
    with pytest.raises(InputError, match="found Bearing, Position, expected one bearing sensor"):
        from_bearings(both, log, (0.0, 0.0))
    with pytest.raises(InputError, match="found Position, expected one bearing sensor alone"):
        BearingLeastSquares((Position(),))
    with pytest.raises(InputError, match="velocity: found 3, expected 2 numbers"):
        BearingLeastSquares((Bearing(),), velocity=(1.0, 2.0, 3.0))


def least_squares(weighted: bool, **options: object) -> BearingLeastSquares:
    sensor = Bearing(sigma=float(oracle.SIGMA))
    return BearingLeastSquares((sensor,), velocity=VELOCITY, weighted=weighted, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("outliers", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
def test_least_squares_of_all_bearings_so_far_is_the_oracles(
    weighted: bool, outliers: bool
) -> None:
    z = noisy(outliers)
    track = least_squares(weighted).estimate(log_of(z))
    expected = (oracle.weighted_ls if weighted else oracle.ls)(z)
    assert track.states == ("x", "y")
    assert track.mean[0].isnan().all()
    assert_close(track.mean[1:], expected[1:], 1e-6)


def test_the_weighted_estimate_is_a_minimum_of_the_squared_residuals() -> None:
    z = noisy()
    track = least_squares(True, iterations=6).estimate(log_of(z))
    time = np.arange(1, 201)[:, None]

    def cost(shift: Array) -> Array:
        back = array(track.mean[-1]) + shift - np.outer(200.0 - time, VELOCITY)[:, None]
        return (oracle.wrap(z - np.arctan2(back[..., 1], back[..., 0])) ** 2).sum(0)

    for shift in ([3.0, 0.0], [-3.0, 0.0], [0.0, 3.0], [0.0, -3.0]):
        assert (cost(np.array(shift)) > cost(np.zeros(2))).all()


@pytest.mark.parametrize("weighted", [False, True])
def test_nothing_is_estimated_before_lines_cross(weighted: bool) -> None:
    z = noisy().copy()[:12]
    z[:3, 0] = np.nan
    z[5:8, 1] = np.nan
    z[:, 2] = np.nan
    track = least_squares(weighted).estimate(log_of(z))
    known = track.mean.isfinite().all(-1)
    assert torch.equal(known, track.std.isfinite().all(-1))
    assert known[:, 0].tolist() == [False] * 4 + [True] * 8
    assert known[:, 1].tolist() == [False] + [True] * 11
    assert not known[:, 2].any()
    moved = track.mean[5:8, 1] - track.mean[4, 1]
    if not weighted:  # a row without a bearing only carries the estimate on
        assert_close(moved, np.outer([1.0, 2.0, 3.0], VELOCITY), 1e-9)
    whole = least_squares(weighted).estimate(log_of(noisy()[:12]))
    assert_close(track.mean[:, 3:][1:], whole.mean[:, 3:][1:], 1e-12)


@pytest.mark.parametrize("weighted", [False, True])
def test_least_squares_follows_a_platform_that_winds(
    rng: np.random.Generator, weighted: bool
) -> None:
    log, state = winding(rng, 4)
    sensor = Bearing(platform=PLATFORM, sigma=1e-3)
    system = BearingLeastSquares((sensor,), velocity=(3.0, -8.0), weighted=weighted)
    track = system.estimate(log)
    since = array(log.time - log.time[0])[:, None, None]
    truth = state[:, :2] + since * state[:, 2:]
    assert_close(track.mean[1:], truth[1:], 1e-6)


@pytest.mark.parametrize("weighted", [False, True])
def test_the_covariance_of_the_fit_is_that_of_its_errors(
    rng: np.random.Generator, weighted: bool
) -> None:
    log, state = winding(rng, 1)
    runs = 2000
    inputs = {name: value.expand(-1, runs) for name, value in log.inputs.items()}
    z = log.z.expand(-1, runs, -1) + 1e-3 * tensor(rng.standard_normal((30, runs, 1)))
    sensor = Bearing(platform=PLATFORM, sigma=1e-3)
    system = BearingLeastSquares((sensor,), velocity=(3.0, -8.0), weighted=weighted)
    track = system.estimate(replace(log, z=z, inputs=inputs))
    since = float(log.time[-1] - log.time[0])
    error = array(track.mean[-1]) - (state[:, :2] + since * state[:, 2:])
    found = error.T @ error / runs
    assert_close(track.covariance[-1].mean(0), found, 0.12)


def test_least_squares_needs_its_own_channels() -> None:
    log = replace(log_of(noisy()), channels=("range",))
    with pytest.raises(InputError, match="found channels range"):
        least_squares(False).estimate(log)


def test_bearings_that_leave_the_distance_open_are_told() -> None:
    """A standing target far off, seen over a baseline that the noise hides."""
    along = torch.arange(6).double()
    inputs = {"platform_x": torch.zeros(6).double(), "platform_y": along}
    z = torch.atan2(-along, torch.full_like(along, 5000.0)).unsqueeze(-1)
    log = Log(("bearing",), along, z, inputs=inputs)
    coarse = platform_filter(Bearing(platform=PLATFORM, sigma=1e-3))
    with pytest.raises(InputError, match="trajectory 0: its first 6 bearings leave its distance"):
        from_bearings(coarse, log, (0.0, 0.0))
    near = replace(log, z=torch.atan2(-along, torch.full_like(along, 50.0)).unsqueeze(-1))
    assert_close(from_bearings(coarse, near, (0.0, 0.0)).mean[0], tensor(50.0), 1e-9)
