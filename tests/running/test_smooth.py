"""Smoothing against a textbook smoother, batch least squares and itself."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import assert_close, tensor

import difffilter as df
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.batch import run
from difffilter.running.smoothing import smooth
from difffilter.sensors.builtin import Position, Range

D = torch.float64


def log_of(rng: np.random.Generator, rows: int = 40, lead: tuple[int, ...] = ()) -> Log:
    """Irregular rows with gaps, wild values and missing channels."""
    time = np.cumsum(rng.uniform(0.05, 1.5, rows))
    time[4] = time[3]
    z = rng.normal(0.0, 3.0, (rows, *lead, 2)) + 5.0 * time.reshape(-1, *[1] * len(lead), 1)
    z[rng.random(z.shape) < 0.2] = np.nan
    z[5] = np.nan
    return Log(("position_1", "position_2"), tensor(time), tensor(z))


def textbook(
    track: df.Track, time: np.ndarray, acceleration: float
) -> tuple[np.ndarray, np.ndarray]:
    """Rauch-Tung-Striebel with a pseudo-inverse, in NumPy, for white acceleration."""
    m, p = track.mean.numpy().copy(), track.covariance.numpy().copy()
    for k in range(len(m) - 2, -1, -1):
        dt = time[k + 1] - time[k]
        f = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2))
        g = np.kron([[dt**2 / 2], [dt]], np.eye(2))
        pred = f @ p[k] @ f.T + acceleration**2 * g @ g.T
        gain = p[k] @ f.T @ np.linalg.pinv(pred, rcond=1e-13, hermitian=True)
        m[k] += gain @ (m[k + 1] - f @ m[k])
        p[k] += gain @ (p[k + 1] - pred) @ gain.T
    return m, p


@pytest.mark.parametrize("p0", [(9.0, 9.0, 4.0, 4.0), (9.0, 0.0, 4.0, 0.0), (0.0,) * 4])
@pytest.mark.parametrize("acceleration", [0.7, 1e-12])
@pytest.mark.parametrize("rule", ["taylor", "cubature"])
def test_equals_the_textbook(
    rng: np.random.Generator, p0: tuple[float, ...], acceleration: float, rule: str
) -> None:
    """Rank-deficient Q (one acceleration per axis), singular P0, rows at the same time."""
    motion = ConstantVelocity(2, noise_kind="discrete", acceleration=acceleration)
    recipe = Filter(motion, (Position(sigma=3.0),), df.huber, linearise=rule)
    log = log_of(rng)
    start = Start(torch.zeros(4, dtype=D), torch.diag(tensor(p0)))
    filtered, smoothed = run(recipe, log, start=start), smooth(recipe, log, start=start)
    mean, covariance = textbook(filtered, log.time.numpy(), acceleration)
    scale = max(1.0, float(np.abs(mean).max()))
    assert_close(smoothed.mean / scale, tensor(mean / scale), 1e-9)
    assert_close(smoothed.covariance, tensor(covariance), 1e-9)
    assert smoothed.record is not None
    assert filtered.record is not None
    assert torch.equal(smoothed.record.weight, filtered.record.weight)


def ranging(sigma: float = 0.2) -> Filter:
    stations = ((0.0, 0.0), (60.0, 0.0), (0.0, 60.0), (60.0, 60.0))
    return Filter(ConstantVelocity(2, acceleration=0.5), (Range(stations=stations, sigma=sigma),))


def ranges(rng: np.random.Generator, sigma: float, rows: int = 25) -> tuple[Log, torch.Tensor]:
    time = torch.arange(rows, dtype=D)
    truth = torch.stack([20.0 + time, 15.0 + 0.5 * time], -1)
    recipe = ranging(sigma)
    h = recipe.sensors[0].predict(truth, {}, recipe.prepare())
    return Log(recipe.channels, time, h + sigma * tensor(rng.standard_normal(h.shape))), truth


def test_near_the_batch_least_squares(rng: np.random.Generator) -> None:
    """The distance to the minimum over the whole track falls with sigma squared."""
    noise, away = rng.standard_normal((25, 4)), []
    for sigma in (0.2, 0.02):
        log, truth = ranges(rng, sigma)
        recipe = Filter(
            ConstantVelocity(2, noise_kind="continuous", acceleration=sigma), ranging(sigma).sensors
        )
        h = recipe.sensors[0].predict(truth, {}, recipe.prepare())
        log = Log(log.channels, log.time, h + sigma * tensor(noise))
        start = Start(tensor([20.0, 15.0, 1.0, 0.5]), sigma**2 * torch.eye(4, dtype=D))
        track = smooth(recipe, log, start=start)
        x = np.tile(start.mean.numpy(), (25, 1)) + np.arange(25)[:, None] * [1, 0.5, 0, 0]
        stations = np.array(recipe.sensors[0].stations)  # type: ignore[attr-defined]
        f = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2))
        q = sigma**2 * np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2))
        white = np.linalg.inv(np.linalg.cholesky(q))
        for _ in range(8):  # Gauss-Newton over the stacked track
            rows, right = [np.eye(100)[:4] / sigma], [(start.mean.numpy() - x[0]) / sigma]
            for k in range(25):
                apart = x[k, :2] - stations
                distance = np.hypot(*apart.T)
                block = np.zeros((4, 100))
                block[:, 4 * k : 4 * k + 2] = apart / distance[:, None] / sigma
                rows.append(block)
                right.append((log.z[k].numpy() - distance) / sigma)
                if k:
                    block = np.zeros((4, 100))
                    block[:, 4 * k : 4 * k + 4] = white
                    block[:, 4 * k - 4 : 4 * k] = -white @ f
                    rows.append(block)
                    right.append(-white @ (x[k] - f @ x[k - 1]))
            step = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0]
            x = x + step.reshape(25, 4)
        away.append(float(np.abs(track.mean.numpy() - x).max()))
    assert away[1] < 0.03 * away[0]


def test_fixed_lag(rng: np.random.Generator) -> None:
    recipe = Filter(ConstantVelocity(2, acceleration=0.7), (Position(sigma=3.0),))
    log = log_of(rng, 30, (2,))
    start = Start(torch.zeros(4, dtype=D), 9.0 * torch.eye(4, dtype=D))
    whole, filtered = smooth(recipe, log, start=start), run(recipe, log, start=start)
    full = smooth(recipe, log, start=start, lag=1e3)
    assert_close(full.mean, whole.mean, 1e-10)
    assert_close(full.covariance, whole.covariance, 1e-10)
    lagged = smooth(recipe, log, start=start, lag=2.0)
    for k in (0, 9, 15, 29):
        last = int((log.time <= log.time[k] + 2.0).sum())
        part = smooth(recipe, log.rows(0, last), start=start)
        assert_close(lagged.mean[k], part.mean[k], 1e-10)
        assert_close(lagged.covariance[k], part.covariance[k], 1e-10)
    none = smooth(recipe, log, start=start, lag=0.0)
    apart = log.time[1:] > log.time[:-1]  # a row at the same time still counts
    assert_close(none.mean[:-1][apart], filtered.mean[:-1][apart], 1e-12)


@pytest.mark.parametrize("singular", [False, True])
def test_gradients(rng: np.random.Generator, singular: bool) -> None:
    recipe = Filter(ConstantVelocity(2, noise_kind="discrete"), (Position(),), df.huber)
    log = log_of(rng, 8)
    p0 = torch.diag(tensor([9.0, 0.0, 4.0, 0.0] if singular else [9.0, 9.0, 4.0, 4.0]))

    def loss(acceleration: torch.Tensor, sigma: torch.Tensor) -> torch.Tensor:
        values = {"motion.acceleration": acceleration, "position.sigma": sigma}
        track = smooth(recipe, log, values, Start(torch.zeros(4, dtype=D), p0))
        return torch.cat([track.mean.flatten(), track.covariance.flatten()])

    given = [tensor(0.7).requires_grad_(), tensor(3.0).requires_grad_()]
    assert torch.autograd.gradcheck(loss, given, atol=1e-6)


def test_float32_stays_semidefinite(rng: np.random.Generator) -> None:
    recipe = Filter(ConstantVelocity(2, acceleration=0.7), (Position(sigma=3.0),))
    log = log_of(rng, 10_000).to(torch.float32)
    track = smooth(recipe, log, start=Start(torch.zeros(4), 100.0 * torch.eye(4)))
    p = track.covariance
    least = torch.linalg.eigvalsh(p)[..., 0]
    assert (least > -1e-6 * p.diagonal(dim1=-2, dim2=-1).amax(-1)).all()


def test_what_cannot_be_smoothed_is_told() -> None:
    log = Log(("position_1", "position_2"), torch.arange(3, dtype=D), torch.zeros(3, 2, dtype=D))
    start = Start(torch.zeros(4, dtype=D), torch.eye(4, dtype=D))
    sensors = tuple(Position(name=name) for name in ("a", "b", "c"))
    fused = df.Fusion(ConstantVelocity(2), sensors)
    with pytest.raises(InputError, match="smooth: found Fusion, expected a filter"):
        smooth(fused, log, start=start)
    with pytest.raises(InputError, match="lag"):
        smooth(Filter(ConstantVelocity(2), (Position(),)), log, start=start, lag=-1.0)
