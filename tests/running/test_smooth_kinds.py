"""Smoothing of adaptations, recovery, weighed priors and manifolds; robust passes."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import assert_close, tensor

import difffilter as df
from difffilter.adaptation.fading import MultipleFading
from difffilter.adaptation.scaling import InnovationScaling
from difffilter.core.beliefs import Measurement
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.stepping import step
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.motions.function import FunctionMotion
from difffilter.robust.recovery import Recovery
from difffilter.running.batch import run
from difffilter.running.smoothing import smooth
from difffilter.sensors.builtin import Position
from difffilter.sensors.sensor import FunctionSensor

D = torch.float64
START = Start(torch.zeros(4, dtype=D), 9.0 * torch.eye(4, dtype=D))
MOTION = ConstantVelocity(2, noise_kind="continuous", acceleration=0.7)


def log_of(rng: np.random.Generator, rows: int = 25) -> Log:
    """A track that jumps, with wild values and gaps."""
    time = np.cumsum(rng.uniform(0.3, 1.5, rows))
    z = rng.normal(0.0, 3.0, (rows, 2)) + 5.0 * time[:, None]
    z[rows // 2 :] += 60.0
    z[min(7, rows - 1)] += 200.0
    z[rng.random(z.shape) < 0.15] = np.nan
    return Log(("position_1", "position_2"), tensor(time), tensor(z))


def oracle(recipe: Filter, log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Rauch-Tung-Striebel with the means and covariances that the filter conditioned on."""
    constants, now = recipe.prepare(), recipe.start(START.mean, 3.0 * torch.eye(4, dtype=D))
    m, p, before = [], [], []
    for k, dt in enumerate(log.intervals().tolist()):
        row = Measurement(log.z[k], tensor(dt))
        prior = recipe.prior(constants, now, row).linear
        now, record = step(recipe, constants, now, row)
        x = prior.factor[..., :4, :] * record.prior_weight.rsqrt()
        before.append((prior.mean.numpy(), (x @ x.mT).numpy()))
        m.append(now.mean.numpy())
        p.append(now.covariance.numpy())
    for k in range(len(m) - 2, -1, -1):
        dt = float(log.time[k + 1] - log.time[k])
        f = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2))
        mean, pred = before[k + 1]
        gain = p[k] @ f.T @ np.linalg.inv(pred)
        m[k] = m[k] + gain @ (m[k + 1] - mean)
        p[k] = p[k] + gain @ (p[k + 1] - pred) @ gain.T
    return np.array(m), np.array(p)


KINDS: dict[str, dict[str, object]] = {
    "weighed prior": {"weight": df.huber, "iterations": 3, "weigh_prior": True},
    "inflated": {
        "weight": df.tukey,
        "scope": "sensor",
        "recovery": Recovery("inflate", rejections=2.0),
    },
    "fading": {"adaptation": df.StrongTracking()},
    "corrected": {"adaptation": df.PredictionCorrection()},
    "scaled": {"adaptation": InnovationScaling(window=5)},
    "fading, cubature": {"adaptation": df.StrongTracking(), "linearise": "cubature"},
}


@pytest.mark.parametrize("kind", KINDS)
def test_what_changes_the_prediction(rng: np.random.Generator, kind: str) -> None:
    recipe = Filter(MOTION, (Position(sigma=3.0),), **KINDS[kind])  # type: ignore[arg-type]
    log = log_of(rng)
    filtered, smoothed = run(recipe, log, start=START), smooth(recipe, log, start=START)
    plain = smooth(Filter(MOTION, (Position(sigma=3.0),)), log, start=START)
    mean, covariance = oracle(recipe, log)
    assert_close(smoothed.mean, tensor(mean), 1e-9)
    assert_close(smoothed.covariance, tensor(covariance), 1e-9)
    assert float((smoothed.mean - plain.mean).abs().max()) > 0.1  # it does something here
    trace = [track.covariance.diagonal(dim1=-2, dim2=-1).sum(-1) for track in (smoothed, filtered)]
    assert (trace[0] <= trace[1] * (1.0 + 1e-9)).all()


def test_what_has_no_link_is_refused(rng: np.random.Generator) -> None:
    recipe = Filter(MOTION, (Position(),), adaptation=MultipleFading())
    with pytest.raises(InputError, match="scales each state's past"):
        smooth(recipe, log_of(rng), start=START)


def heading(wraps: bool) -> Filter:
    """An angle and its rate, on a circle or on the line."""

    def ahead(x: torch.Tensor, dt: torch.Tensor, inputs: object, values: object) -> torch.Tensor:
        angle = x[..., 0] + dt * x[..., 1]
        return torch.stack([wrapped(angle) if wraps else angle, x[..., 1]], -1)

    def noise(dt: torch.Tensor, values: object) -> torch.Tensor:
        column = torch.stack([dt**2 / 2.0, dt + 0.0 * dt], -1)
        return 0.3 * column.unsqueeze(-1)

    def wrapped(angle: torch.Tensor) -> torch.Tensor:
        return torch.remainder(angle + math.pi, 2 * math.pi) - math.pi

    def both(x: torch.Tensor) -> torch.Tensor:
        return torch.stack([wrapped(x[..., 0]), x[..., 1]], -1)

    motion = FunctionMotion(("angle", "rate"), ahead, noise)
    if wraps:
        motion = replace(
            motion,
            retract_function=lambda m, s: both(m + s),
            local_function=lambda a, b: both(b - a),
        )

    def seen(x: torch.Tensor, inputs: object, values: object) -> torch.Tensor:
        return x[..., 1:2]

    sensor = FunctionSensor(("rate_seen",), seen, 0.2, name="seen")
    return Filter(motion, (sensor,))


def test_an_angle_that_wraps(rng: np.random.Generator) -> None:
    """Smoothed on the circle is smoothed on the line, but for whole turns; any lag too."""
    log = Log(("rate_seen",), torch.arange(20, dtype=D), tensor(rng.normal(1.0, 0.3, (20, 1))))
    start = Start(torch.zeros(2, dtype=D), 0.01 * torch.eye(2, dtype=D))
    for lag in (math.inf, 3.0):
        line = smooth(heading(False), log, start=start, lag=lag)
        circle = smooth(heading(True), log, start=start, lag=lag)
        assert float(line.mean[:, 0].max()) > 10.0
        assert float(circle.mean[:, 0].abs().max()) <= math.pi
        apart = circle.mean - line.mean
        assert float(torch.sin(apart[:, 0] / 2.0).abs().max()) < 1e-10
        assert float(apart[:, 1].abs().max()) < 1e-10
        assert_close(circle.covariance, line.covariance, 1e-10)


def test_passes_reach_the_estimate_of_the_whole_track(rng: np.random.Generator) -> None:
    """Huber on a linear model: the minimum that weighted least squares in NumPy agrees with."""
    recipe = Filter(MOTION, (Position(sigma=3.0),), df.huber)
    log = log_of(rng, 12)
    track = smooth(recipe, log, start=START, passes=20)
    time, z = log.time.numpy(), log.z.numpy()
    weight = np.ones_like(z)
    for _ in range(100):
        rows, right = [np.eye(48)[:4] / 3.0], [np.zeros(4)]
        for k in range(12):
            for i in np.flatnonzero(~np.isnan(z[k])):
                root = np.sqrt(weight[k, i]) / 3.0
                rows.append(root * np.eye(48)[[4 * k + i]])
                right.append(root * z[k, [i]])
            if k:
                dt = time[k] - time[k - 1]
                f = np.kron([[1.0, dt], [0.0, 1.0]], np.eye(2))
                q = np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2)) * 0.49
                white, block = np.linalg.inv(np.linalg.cholesky(q)), np.zeros((4, 48))
                block[:, 4 * k : 4 * k + 4] = white
                block[:, 4 * k - 4 : 4 * k] = -white @ f
                rows.append(block)
                right.append(np.zeros(4))
        x = np.linalg.lstsq(np.vstack(rows), np.concatenate(right), rcond=None)[0].reshape(12, 4)
        size = np.abs(z - x[:, :2]) / 3.0
        weight = 1.345 / np.maximum(size, 1.345)
        weight = np.where(np.isnan(z), 1.0, weight)
    assert recipe.published()["huber.k"] == pytest.approx(1.345)
    assert_close(track.mean, tensor(x), 1e-5)
    assert track.record is not None
    assert_close(track.record.weight, tensor(np.where(np.isnan(z), 0.0, weight)), 1e-5)
    once = smooth(recipe, log, start=START)
    assert float((once.mean - track.mean).abs().max()) > 1.0


def test_passes_need_a_weight_of_each_channel(rng: np.random.Generator) -> None:
    log = log_of(rng, 5)
    for options, found in (({}, "plain"), ({"weight": df.huber, "scope": "all"}, "scope all")):
        recipe = Filter(MOTION, (Position(),), **options)  # type: ignore[arg-type]
        with pytest.raises(InputError, match=f"passes: found .*{found}"):
            smooth(recipe, log, start=START, passes=1)
    with pytest.raises(InputError, match="passes: found -1"):
        smooth(Filter(MOTION, (Position(),), df.huber), log, start=START, passes=-1)
