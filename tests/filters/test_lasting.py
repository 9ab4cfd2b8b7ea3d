"""Errors that last: equal to an augmented filter by hand, on every road that a recipe goes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

import difffilter as df
from difffilter.errors import InputError
from difffilter.running.batch import start_belief

ANCHORS = [(0.0, 0.0), (9.0, 0.0), (0.0, 9.0), (9.0, 9.0)]
START = df.Start(torch.tensor([2.0, 3.0, 0.0, 0.0], dtype=torch.float64))
BLOCKS = {
    "common": (None, (0.2, 1.4)),
    "own": ((0.3, 2.0), None),
    "both": ((0.1, (1.0, 2.0, 3.0, 4.0)), (0.2, 1.4)),
}

Array = NDArray[np.float64]


def lasting(block: str, **more: object) -> df.Filter:
    own, common = BLOCKS[block]
    anchors = df.Range(stations=ANCHORS, sigma=0.1)
    sensor = df.Lasting(anchors, own=own, common=common)
    motion = df.ConstantVelocity(2, acceleration=0.7)
    return df.Filter(motion, (sensor,), start_sigma=(2.0, 2.0, 1.0, 1.0), **more)  # type: ignore[arg-type]


def ranges(rows: int = 60) -> df.Log:
    """Uneven times, a row without any range and one without one of them."""
    draw = torch.Generator().manual_seed(3)
    time = torch.cumsum(0.05 + 0.2 * torch.rand(rows, generator=draw).double(), 0)
    truth = torch.stack([2.0 + 0.5 * time, 3.0 + 0.3 * time], -1)
    z = (truth[:, None] - torch.tensor(ANCHORS, dtype=torch.float64)).norm(dim=-1)
    z = z + 0.1 * torch.randn(z.shape, generator=draw).double() + 0.2
    z[5] = torch.nan
    z[7, 2] = torch.nan
    channels = lasting("common").channels
    return df.Log(channels, time, z, truth, ("x", "y"))


def by_hand(block: str, log: df.Log) -> tuple[Array, Array]:
    """Means and covariances of the augmented extended Kalman filter, joint updates."""
    own, common = BLOCKS[block]
    sigma, tau = [], []
    for pair, count in ((own, 4), (common, 1)):
        if pair is not None:
            sigma.append(np.broadcast_to(pair[0], count))
            tau.append(np.broadcast_to(pair[1], count))
    s, t = np.concatenate(sigma), np.concatenate(tau)
    e = len(s)
    m = np.r_[2.0, 3.0, 0.0, 0.0, np.zeros(e)]
    p = np.diag(np.r_[4.0, 4.0, 1.0, 1.0, s**2])
    stations, times, z = np.array(ANCHORS), log.time.numpy(), log.z.numpy()
    means, covariances = [], []
    for k in range(log.steps):
        dt = times[k] - times[k - 1] if k else 0.0
        f = np.eye(4 + e)
        f[0, 2] = f[1, 3] = dt
        a = np.exp(-dt / t)
        f[4:, 4:] = np.diag(a)
        g = np.zeros((4 + e, 2))
        g[0, 0] = g[1, 1] = dt**2 / 2
        g[2, 0] = g[3, 1] = dt
        q = 0.49 * g @ g.T
        q[4:, 4:] += np.diag(s**2 * (1 - a**2))
        m, p = f @ m, f @ p @ f.T + q
        apart = m[:2] - stations
        distance = np.linalg.norm(apart, axis=1)
        h = np.zeros((4, 4 + e))
        h[:, :2] = apart / distance[:, None]
        if own is not None:
            h[:, 4:8] = np.eye(4)
        if common is not None:
            h[:, -1] = 1.0
        there = ~np.isnan(z[k])
        predicted = distance + h[:, 4:] @ m[4:]
        h = h[there]
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + 0.01 * np.eye(len(h)))
        m = m + gain @ (z[k] - predicted)[there]
        p = p - gain @ h @ p
        means.append(m)
        covariances.append(p)
    return np.array(means), np.array(covariances)


@pytest.mark.parametrize("block", BLOCKS)
def test_block_equals_the_augmented_filter_by_hand(block: str) -> None:
    log = ranges()
    track = df.run(lasting(block), log, start=START, engine="torch")
    mean, covariance = by_hand(block, log)
    assert np.allclose(track.mean.numpy(), mean, rtol=0.0, atol=1e-9)
    assert np.allclose(track.covariance.numpy(), covariance, rtol=0.0, atol=1e-9)


def test_engine_equals_torch_and_gradients_agree() -> None:
    track = [df.run(lasting("both"), ranges(), start=START, engine=e) for e in ("torch", "fused")]
    assert torch.allclose(track[0].mean, track[1].mean, rtol=0.0, atol=1e-12)
    fix = df.Lasting(df.Position(name="fix", axes=1), own=(0.3, 2.0))
    recipe = df.Filter(df.ConstantVelocity(1), (fix,), start_sigma=1.0, tuned=["fix.own*"])
    time, z = torch.arange(9).double(), torch.linspace(0.0, 4.0, 9).double().sin()[:, None, None]
    start = df.Start(torch.zeros(1, 2).double())
    batch = df.Log(recipe.channels, time, z, 0.0 * z, ("x",), start=start)
    found = {}
    for engine in ("torch", "fused"):
        parameters = df.ParameterSet(recipe.declarations)
        problem = df.Problem(recipe, batch, {"position": 1.0, "consistency": 0.1}, engine=engine)
        value, _ = df.objective(problem, parameters.values())
        value.backward()
        found[engine] = {n: p.grad for n, p in parameters.free().items()}
    assert set(found["torch"]) == {"fix.own_error", "fix.own_time"}
    for name, gradient in found["torch"].items():
        other = found["fused"][name]
        assert gradient is not None
        assert other is not None
        assert bool((gradient != 0.0).any())
        assert torch.allclose(gradient, other, rtol=1e-7, atol=1e-10)


def test_start_of_the_own_states_has_stationary_errors() -> None:
    recipe = lasting("both")
    values = recipe.complete({"range.common_error": torch.tensor(0.5, dtype=torch.float64)})
    begin = start_belief(recipe, recipe.prepare(values), START)
    expected = torch.tensor([2.0, 2.0, 1.0, 1.0, 0.1, 0.1, 0.1, 0.1, 0.5], dtype=torch.float64)
    assert begin.mean.tolist() == [2.0, 3.0, *[0.0] * 7]
    assert torch.allclose(begin.deviations, torch.diag(expected))
    tracker = df.Tracker(recipe, [2.0, 3.0, 0.0, 0.0], torch.eye(4).double())
    assert tracker.belief.mean.shape == (9,)
    found = df.from_measurements(recipe, ranges())
    assert found.mean.shape == (4,)
    assert (found.mean[:2] - START.mean[:2]).norm() < 0.5


def test_smoothing_is_that_of_the_augmented_model() -> None:
    """Rauch, Tung and Striebel in NumPy, on the filter's own numbers."""
    recipe, log = lasting("common"), ranges()
    track = df.run(recipe, log, start=START)
    smooth = df.smooth(recipe, log, start=START)
    mean, covariance = track.mean.numpy(), track.covariance.numpy()
    m, p = mean[-1], covariance[-1]
    for k in range(log.steps - 2, -1, -1):
        dt = float(log.time[k + 1] - log.time[k])
        a = np.exp(-dt / 1.4)
        f = np.diag([1.0, 1.0, 1.0, 1.0, a])
        f[0, 2] = f[1, 3] = dt
        g = np.zeros((5, 2))
        g[0, 0] = g[1, 1] = dt**2 / 2
        g[2, 0] = g[3, 1] = dt
        q = 0.49 * g @ g.T
        q[4, 4] = 0.04 * (1 - a**2)
        ahead = f @ covariance[k] @ f.T + q
        gain = covariance[k] @ f.T @ np.linalg.inv(ahead)
        m = mean[k] + gain @ (m - f @ mean[k])
        p = covariance[k] + gain @ (p - ahead) @ gain.T
        assert np.allclose(smooth.mean[k].numpy(), m, rtol=0.0, atol=1e-9)
        assert np.allclose(smooth.covariance[k].numpy(), p, rtol=0.0, atol=1e-9)


def test_placing_again_changes_nothing() -> None:
    recipe = lasting("both", weight=df.huber)
    again = replace(recipe, linearise="taylor")
    assert again == recipe
    assert again.states == recipe.states
    moved = df.stack_logs([ranges()])
    moved = replace(moved, start=df.Start(START.mean[None]))
    assert torch.equal(df.run(again, moved).mean, df.run(recipe, moved).mean)


def test_other_sensors_do_not_see_the_errors() -> None:
    """A function of the last state still reads the last of the motion's own."""

    def rate(state: torch.Tensor, inputs: object, values: object) -> torch.Tensor:
        return state[..., -1:]

    north = df.FunctionSensor(("north",), rate, sigma=0.2, unit="m/s", name="north")
    sensor = df.Lasting(df.Range(stations=ANCHORS), common=(0.2, 1.4))
    recipe = df.Filter(df.ConstantVelocity(2), (north, sensor), start_sigma=1.0)
    state = torch.arange(5).double()
    assert recipe.sensors[0].predict(state, {}, recipe.prepare()).tolist() == [3.0]
    _, columns = recipe.sensors[0].observe(state, torch.eye(5).double(), {}, recipe.prepare())
    assert columns.tolist() == [[0.0, 0.0, 0.0, 1.0, 0.0]]


def test_cubature_equals_taylor_where_all_is_linear() -> None:
    fix = df.Lasting(df.Position(sigma=0.3), own=(0.2, 1.0), common=(0.1, 3.0))
    log = ranges()
    log = df.Log(("position_1", "position_2"), log.time, log.z[:, :2])
    tracks = [
        df.run(df.Filter(df.ConstantVelocity(2), (fix,), start_sigma=1.0, linearise=rule), log,
               start=START, engine="torch")
        for rule in ("taylor", "cubature")
    ]  # fmt: skip
    assert torch.allclose(tracks[0].mean, tracks[1].mean, atol=1e-10)
    assert torch.allclose(tracks[0].covariance, tracks[1].covariance, atol=1e-10)


def test_mixture_of_modes_with_errors() -> None:
    calm, wild = lasting("common"), lasting("common")
    wild = wild.with_values({"motion.acceleration": torch.tensor(5.0, dtype=torch.float64)})
    modes = {n: replace(mode, start_sigma=None) for n, mode in (("calm", calm), ("wild", wild))}
    both = df.Mixture(modes, start_sigma=(2.0, 2.0, 1.0, 1.0))
    track = df.run(both, ranges(), start=START)
    assert track.mean.shape == (60, 5)
    assert bool(torch.isfinite(track.mean).all())


def test_refusals() -> None:
    anchors = df.Range(stations=ANCHORS)
    with pytest.raises(InputError, match="range: found no error that lasts, expected own or"):
        df.Lasting(anchors)
    with pytest.raises(InputError, match=r"range.common_error: found shape \[2\], expected one"):
        df.Filter(df.ConstantVelocity(), (df.Lasting(anchors, common=((1.0, 2.0), 1.0)),))  # type: ignore[arg-type]
    around = df.Delayed(df.Lasting(anchors, common=(0.1, 1.0)))
    with pytest.raises(InputError, match="expected Lasting outermost"):
        df.Filter(df.ConstantVelocity(), (around,))
    with pytest.raises(InputError, match=r"found mean of shape \[3\], expected 5 numbers"):
        df.run(lasting("common"), ranges(), start=df.Start(torch.zeros(3).double()))
