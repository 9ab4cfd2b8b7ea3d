"""Hidden measurements against the smoother that did not have them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import assert_close, tensor

import difffilter as df
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.hiding import HIDDEN, Hiding
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.interpolation import interpolated
from difffilter.running.objectives import objective, sum_losses
from difffilter.running.problem import Problem
from difffilter.scoring.hiding import hide_windows
from difffilter.sensors.builtin import Position

D = torch.float64
RECIPE = Filter(ConstantVelocity(1, acceleration=0.5), (Position(axes=1, sigma=1.0),))


def log_of(rows: int = 14) -> Log:
    rng = np.random.default_rng(4)
    z = rng.standard_normal((rows, 1)) + np.arange(rows)[:, None]
    start = Start(torch.zeros(2, dtype=D), 4.0 * torch.eye(2, dtype=D))
    return Log(RECIPE.channels, torch.arange(rows, dtype=D), tensor(z), start=start)


def test_equals_regression_on_all_other_rows() -> None:
    """The joint normal of all rows, in NumPy: hidden given the rest, mean and variance."""
    hidden = hide_windows(log_of(), 2.0, parts=2, seed=1)
    track = interpolated(RECIPE, hidden)
    f = np.array([[1.0, 1.0], [0.0, 1.0]])
    q = RECIPE.motion.noise(torch.zeros(2, dtype=D), tensor(1.0), {}, RECIPE.prepare()).numpy()
    cov, rows = np.zeros((14, 14)), [4.0 * np.eye(2)]
    for _ in range(13):
        rows.append(f @ rows[-1] @ f.T + q @ q.T)
    for i in range(14):
        for j in range(i, 14):
            cross = np.linalg.matrix_power(f, j - i) @ rows[i]
            cov[i, j] = cov[j, i] = cross[0, 0]
    joint = cov + np.eye(14)
    z = log_of().z[:, 0].numpy()
    assert track.record is not None
    for part in (0, 1):
        out = hidden.inputs[HIDDEN][:, part, 0].numpy() > 0.5
        gain = np.linalg.solve(joint[np.ix_(~out, ~out)], joint[np.ix_(~out, out)]).T
        apart = z[out] - gain @ z[~out]
        variance = np.diag(joint[np.ix_(out, out)] - gain @ joint[np.ix_(~out, out)])
        record = track.record
        assert_close(record.innovation[out, part, 0], tensor(apart), 1e-9)
        assert_close(record.innovation_variance[out, part, 0], tensor(variance), 1e-9)
        assert torch.equal(record.present[:, part, 0], torch.tensor(out))


def test_windows_hide_each_row_but_the_first_ones_once() -> None:
    mask = hide_windows(log_of(40), 3.0, parts=3, seed=5).inputs[HIDDEN]
    assert torch.equal(mask.sum((1, 2)), torch.tensor([0.0] * 3 + [1.0] * 37, dtype=D))
    other = hide_windows(log_of(40), 3.0, parts=3, seed=6).inputs[HIDDEN]
    assert not torch.equal(mask, other)
    with pytest.raises(InputError, match="hide windows: found a log of 13 s"):
        hide_windows(log_of(), 5.0)


def test_the_loss_is_of_the_smoothed_innovations() -> None:
    """Value, gradient and the sums' tangents."""
    values = {n: v.requires_grad_() for n, v in RECIPE.published().items()}
    hidden = hide_windows(log_of(), 2.0, parts=2)
    problem = Problem(Hiding(RECIPE, smoothed=True), hidden, {"normal-likelihood": 1.0})
    loss, _ = objective(problem, values)
    record = interpolated(RECIPE, hidden).record
    assert record is not None
    assert_close(loss, -record.log_density.sum() / record.present.sum(), 1e-12)
    name = "motion.acceleration"
    loss.backward()
    slope = values[name].grad
    assert slope is not None
    near = [objective(problem, {name: values[name].detach() + step})[0] for step in (-1e-5, 1e-5)]
    assert_close(slope, (near[1] - near[0]) / 2e-5, 1e-6)
    leaf = {name: values[name]}
    sums = sum_losses(problem, leaf)
    total = sums.values.sum(0).detach()
    assert_close(total[0] / total[1], loss.detach(), 1e-12)
    assert_close(sums.tangents[:, 0, 0].sum() / total[1], slope, 1e-9)


def test_tune_on_random_windows() -> None:
    """The road that ``hide = "windows"`` takes; the compiled engine is refused by name."""
    recipe, log = replace(RECIPE, start_sigma=(3.0, 3.0)), replace(log_of(40), start=None)
    settings = {"hide": "windows", "ahead": 1.5, "steps": 1, "loss": {"likelihood": 1.0}}
    found = df.tune(recipe, log, tuned=["position.sigma"], settings=settings)
    assert torch.isfinite(found.checkpoint.values["position.sigma"])
    with pytest.raises(InputError, match="found engine fused, expected torch"):
        df.tune(recipe, log, tuned=["position.sigma"], settings=settings, engine="fused")
