"""Starts over random geometries, with wild rows: right, or refused; covered by their covariance."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import tensor

import difffilter as df
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.sensors.builtin import TDOA, Bearing, Position, Range
from difffilter.start.measurements import from_measurements

NAN = float("nan")
SIGMA = {"ranges": 0.3, "tdoa": 0.3, "positions": 2.0, "bearings": 0.02}


def geometry(kind: str, rng: np.random.Generator) -> tuple[Filter, object]:
    """A filter on random stations, and h(position (.., 2), platform (.., 2)) in NumPy."""
    stations = rng.uniform(-50.0, 50.0, (5, 2))
    points = [tuple(p) for p in stations.tolist()]

    def distance(p: np.ndarray) -> np.ndarray:
        return np.hypot(*(p[..., None, :] - stations).transpose(-1, *range(p.ndim)))

    if kind == "ranges":
        sensor, h = Range(stations=points, sigma=0.3), lambda p, o: distance(p)
    elif kind == "tdoa":
        sensor = TDOA(stations=points, sigma=0.3)
        h = lambda p, o: distance(p)[..., 1:] - distance(p)[..., :1]  # noqa: E731
    elif kind == "positions":
        sensor, h = Position(sigma=2.0), lambda p, o: p
    else:
        sensor = Bearing(platform=("px", "py"), sigma=0.02)
        h = lambda p, o: np.arctan2(*(p - o)[..., ::-1].transpose(-1, *range(p.ndim - 1)))[  # noqa: E731
            ..., None
        ]
    return Filter(ConstantVelocity(2), (sensor,), start_sigma=5.0), h


def simulated(
    kind: str, seed: int, runs: int = 12, rows: int = 60, wild: bool = True
) -> tuple[Filter, Log, np.ndarray, object]:
    """Slowly moving targets; one row in ten is wild; a moving platform for bearings."""
    rng = np.random.default_rng(seed)
    recipe, h = geometry(kind, rng)
    time = 0.1 * np.arange(rows)
    p0, v = rng.uniform(-40.0, 40.0, (runs, 2)), rng.normal(0.0, 0.3, (runs, 2))
    path = p0 + time[:, None, None] * v
    platform = np.stack([np.full(rows, -80.0), -60.0 + 12.0 * time], -1)
    exact = h(path, platform[:, None])
    z = exact + SIGMA[kind] * rng.standard_normal(exact.shape)
    if wild:
        struck = rng.permuted(np.tile(np.arange(rows) % 10 == 0, (runs, 1)), axis=1).T
        far = rng.uniform(-1.0, 1.0, exact.shape) * (2.0 if kind == "bearings" else 80.0)
        z = np.where(struck[..., None], z + far, z)
    inputs = {
        name: tensor(platform[:, i]).unsqueeze(-1).expand(rows, runs)
        for i, name in enumerate(("px", "py"))
        if kind == "bearings"
    }
    names = tuple(f"run{i}" for i in range(runs))
    truth = np.concatenate([p0, v], -1)
    return (
        recipe,
        Log(recipe.channels, tensor(time), tensor(z), inputs=inputs, names=names),
        truth,
        h,
    )


def one(log: Log, i: int) -> Log:
    return log.select([i])


@pytest.mark.parametrize("kind", list(SIGMA))
@pytest.mark.parametrize("seed", range(3))
def test_right_or_refused(kind: str, seed: int) -> None:
    """With one wild row in ten no start is wrong in silence."""
    recipe, log, truth, _ = simulated(kind, seed)
    refused = 0
    for i in range(log.trajectories):
        try:
            start = from_measurements(recipe, one(log, i), velocity_sigma=0.5)
        except InputError as error:
            refused += 1 if f"run{i}" in str(error) else 100
            continue
        assert start.covariance is not None
        miss = start.mean[0].numpy() - truth[i]
        assert miss @ np.linalg.solve(start.covariance[0].numpy(), miss) < 40.0
    assert refused <= 3


def cauchy(theta: np.ndarray, h: object, z: np.ndarray, kind: str, platform: np.ndarray) -> float:
    """The documented cost, in NumPy."""
    e = z - h(np.broadcast_to(theta, (len(z), 2)), platform)  # type: ignore[operator]
    if kind == "bearings":
        e = np.arctan2(np.sin(e), np.cos(e))
    s = (e / (3.0 * SIGMA[kind])) ** 2
    s = s.sum(-1) if kind == "positions" else s
    return float(np.log1p(s).sum())


@pytest.mark.parametrize("kind", ["ranges", "tdoa", "positions"])
def test_no_independent_search_finds_a_lower_cost(kind: str) -> None:
    """A grid and a shrinking pattern search, sharing no code, on the same ten rows."""
    recipe, log, _, h = simulated(kind, 7, runs=6)
    start = from_measurements(recipe, log)
    if start.covariance is not None:
        pytest.fail("expected starts from ten rows")
    for i in range(6):
        z = log.z[:10, i].numpy()
        found = cauchy(start.mean[i, :2].numpy(), h, z, kind, np.zeros((10, 2)))
        grid = np.stack(np.meshgrid(*[np.linspace(-60, 60, 49)] * 2), -1).reshape(-1, 2)
        value = [cauchy(p, h, z, kind, np.zeros((10, 2))) for p in grid]
        best, size = grid[int(np.argmin(value))], 2.5
        while size > 1e-7:
            around = best + size * np.array([[0, 0], [1, 0], [-1, 0], [0, 1], [0, -1]])
            costs = [cauchy(p, h, z, kind, np.zeros((10, 2))) for p in around]
            best, size = around[int(np.argmin(costs))], size if np.argmin(costs) else size / 2
        assert found <= cauchy(best, h, z, kind, np.zeros((10, 2))) + 1e-9


@pytest.mark.parametrize(("kind", "wild"), [("ranges", True), ("tdoa", False), ("positions", True)])
def test_the_covariance_covers_the_truth(kind: str, wild: bool) -> None:
    """Over 300 targets: the mean squared distance in sigmas is that of the states or less."""
    recipe, log, truth, _ = simulated(kind, 11, runs=300, wild=wild)
    start = from_measurements(recipe, log, velocity_sigma=0.3)
    assert start.covariance is not None
    miss = (start.mean.numpy() - truth)[..., None]
    square = (miss * np.linalg.solve(start.covariance.numpy(), miss)).sum((-2, -1))
    assert 1.5 < square.mean() < 4.6  # 4 states
    assert np.mean(square > 13.28) < 0.03  # 1 % of a chi-square with 4 degrees


def test_a_wild_fix_on_a_ray_waits_for_others() -> None:
    """Bearings from a standing platform, and a first fix that is wild as a whole."""
    rng = np.random.default_rng(5)
    sensors = (
        Position(name="radar", sigma=5.0),
        Bearing(name="eo", platform=("px", "py"), sigma=0.035),
    )
    recipe = Filter(ConstantVelocity(2), sensors, start_sigma=(10.0, 10.0, 3.0, 3.0))
    truth, rows = np.array([-70.0, -95.0]), 120
    z = np.full((rows, 3), np.nan)
    z[:, 2] = np.arctan2(*truth[::-1]) + 0.035 * rng.standard_normal(rows)
    z[7::20, :2] = truth + 5.0 * rng.standard_normal((6, 2))
    z[7, :2] = (210.0, 0.0)
    zeros = torch.zeros(rows, dtype=torch.float64)
    log = Log(
        recipe.channels,
        0.08 * torch.arange(rows).double(),
        tensor(z),
        inputs={"px": zeros, "py": zeros},
    )
    start = from_measurements(recipe, log)
    assert start.covariance is not None
    miss = start.mean.numpy() - np.array([*truth, 0.0, 0.0])
    assert np.hypot(*miss[:2]) < 15.0
    assert miss @ np.linalg.solve(start.covariance.numpy(), miss) < 15.0
    # The wild one alone, to the end of the log: what it says contradicts the bearings.
    z[8:, :2] = NAN
    with pytest.raises(InputError, match=r"trajectory 0: .*(contradict|alike)"):
        from_measurements(recipe, Log(recipe.channels, log.time, tensor(z), inputs=log.inputs))
    only = from_measurements(recipe, log, sensors=("radar",), rows=40, span=20.0)
    assert np.hypot(*(only.mean[:2].numpy() - truth)) < 10.0


def test_a_mirror_image_is_told(rng: np.random.Generator) -> None:
    """Stations on a line: two places fit alike, and both are named."""
    sensor = Range(stations=((0.0, 0.0), (10.0, 0.0), (25.0, 0.0)), sigma=0.1)
    recipe = Filter(ConstantVelocity(2), (sensor,), start_sigma=1.0)
    truth = tensor([12.0, 9.0])
    z = sensor.predict(truth, {}, recipe.prepare()) + 0.1 * tensor(rng.standard_normal((40, 3)))
    log = Log(recipe.channels, 0.1 * torch.arange(40).double(), z)
    with pytest.raises(InputError, match=r"\(1\d?\.?\d*, -?[89]\.\d+\) and \(1.*alike"):
        from_measurements(recipe, log)


def test_time_may_be_a_tensor() -> None:
    start = Start(torch.zeros(2), None, torch.tensor(1.5))  # type: ignore[arg-type]
    assert start.time == 1.5
    log = Log(("a",), tensor([2.0, 3.0]), tensor([[0.0], [0.0]]))
    assert log.intervals(start.time).tolist() == [0.5, 1.0]
    for wrong in (torch.zeros(2), NAN, "now"):
        with pytest.raises(InputError, match=r"start\.time"):
            Start(torch.zeros(2), None, wrong)  # type: ignore[arg-type]


def observer(wild: bool) -> tuple[Filter, Log]:
    """A standing target, a camera on a slow platform, few radar fixes of which one is wild."""
    rng = np.random.default_rng(8)
    sensors = (
        Position(name="radar", sigma=5.0),
        Bearing(name="eo", platform=("px", "py"), sigma=0.035),
    )
    recipe = Filter(
        ConstantVelocity(2, acceleration=0.3), sensors, df.igg3, start_sigma=(10.0, 10.0, 3.0, 3.0)
    )
    truth, rows = np.array([-70.0, -95.0]), 240
    time = 0.08 * np.arange(rows)
    platform = np.stack([-0.08 * time, -0.12 * time], -1)
    z = np.full((rows, 2, 3), np.nan)
    apart = truth - platform
    z[..., 2] = np.arctan2(apart[:, 1], apart[:, 0])[:, None]
    z[..., 2] += 0.035 * rng.standard_normal((rows, 2))
    z[7::20, :, :2] = truth + 5.0 * rng.standard_normal((12, 2, 2))
    z[0, 1, :2] = truth + 1.0
    if wild:
        z[7, 0, :2] = (210.0, 0.0)
    inputs = {n: tensor(platform[:, [i, i]]) for i, n in enumerate(("px", "py"))}
    return recipe, Log(
        recipe.channels, tensor(time), tensor(z),
        truth=tensor(np.broadcast_to(truth, (rows, 2, 2)).copy()), truth_states=("x", "y"),
        inputs=inputs,
    )  # fmt: skip


def test_who_does_not_wait_keeps_start_sigma() -> None:
    """A wild fix makes one trajectory wait: the other's start.sigma keeps its gradient."""
    recipe, log = observer(wild=True)
    start = from_measurements(recipe, log)
    assert start.covariance is not None
    assert torch.isnan(start.covariance).all(-1).all(-1).tolist() == [False, True]
    sigma = tensor([10.0, 10.0, 3.0, 3.0]).requires_grad_()
    track = df.run(recipe, log, {"start.sigma": sigma}, start)
    (slope,) = torch.autograd.grad(track.mean[-1, 1].sum() + track.mean[0, 1].sum(), sigma)
    assert float(slope.abs().sum()) > 0.0
    (none,) = torch.autograd.grad(
        df.run(recipe, log, {"start.sigma": sigma}, start).mean[:, 0].sum(), sigma
    )
    assert not bool(none.any())
    alone = df.run(recipe, log.select([1]), start=Start(start.mean[1:]))
    assert torch.allclose(track.mean[:, 1], alone.mean[:, 0], atol=1e-12)


def test_tuning_on_a_wild_first_fix_keeps_the_noise() -> None:
    """A start at the observer would make the radar's sigma 23 m in place of 5."""
    recipe, log = observer(wild=True)
    found = df.tune(recipe, log, validation=log, tuned=["radar.sigma"], settings={"steps": 10})
    assert 3.0 < float(found.checkpoint.values["radar.sigma"]) < 8.0


CASE = """
schema = 1
name = "own"
title = "A start of one's own"
[sensors.radar]
kind = "position"
[sensors.other]
kind = "position"
[motion]
noise = "continuous"
[parameters.motion.acceleration]
value = 0.3
[parameters.radar.sigma]
value = 5.0
[parameters.other.sigma]
value = 5.0
[parameters.start.sigma]
value = 3.0
[systems.ekf]
[start]
"""


def started(tmp_path: Path, keys: str) -> Start:
    """The start of a log that moves at (2, -1) m/s and has truth."""
    path = tmp_path / "own.toml"
    path.write_text(CASE + keys)
    scenario = df.load_scenario(path)
    time = torch.arange(30).double()
    truth = torch.stack([2.0 * time + 10.0, -time], -1)
    log = Log(scenario.channels, time, torch.cat([truth, truth + 100.0], -1), truth, ("x", "y"))
    start = df.started(scenario, scenario.system(), log).start
    assert start is not None
    return start


def test_start_keys(tmp_path: Path) -> None:
    given = started(tmp_path, "position = [1.0, 2.0]\nvelocity = [3.0, 4.0]\ntime = -1.0")
    assert given.mean.tolist() == [1.0, 2.0, 3.0, 4.0]
    assert given.covariance is None
    assert given.time == -1.0
    spread = started(tmp_path, "position = [1.0, 2.0]\ncovariance = [4.0, 4.0, 1.0, 1.0]")
    assert spread.covariance is not None
    assert spread.covariance.diagonal().tolist() == [4.0, 4.0, 1.0, 1.0]
    true = started(tmp_path, 'kind = "truth"\nposition_sigma = 2.0\nvelocity_sigma = 1.0')
    assert torch.allclose(true.mean, tensor([10.0, 0.0, 2.0, -1.0]), atol=1e-12)
    assert true.covariance is not None
    assert true.covariance.diagonal().tolist() == [4.0, 4.0, 1.0, 1.0]
    radar = started(tmp_path, 'sensors = ["radar"]\nspan = 0.5')
    assert torch.allclose(radar.mean[:2], tensor([10.0, 0.0]), atol=1e-9)
    other = started(tmp_path, 'sensors = ["other"]\nspan = 0.0')
    assert torch.allclose(other.mean[:2], tensor([110.0, 100.0]), atol=1e-9)
    moving = started(tmp_path, 'sensors = ["radar"]\nvelocity = [2.0, -1.0]\nspan = 9.0')
    assert torch.allclose(moving.mean, tensor([10.0, 0.0, 2.0, -1.0]), atol=1e-6)


@pytest.mark.parametrize(
    ("keys", "expected"),
    [
        ('kind = "given"', "start.position"),
        ('kind = "measurements"\ntime = 3.0', "start.time"),
        ('sensors = ["lidar"]', "start.sensors"),
        ("position = [1.0]", "start.position"),
        ("position = [1.0, 2.0]\ncovariance = [1.0, 2.0]", "start.covariance"),
        ("position = [1.0, 2.0]\ncovariance = [[1.0, 2.0], [3.0]]", "start.covariance"),
        ("position = [1.0, 2.0]\ncovariance = [-1.0, 2.0, 1.0, 1.0]", "start.covariance"),
        ("span = -1.0", "start.span"),
    ],
)
def test_wrong_start_keys(tmp_path: Path, keys: str, expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        started(tmp_path, keys)
