"""Hidden measurements: the belief without them, and what the rest foretells of them."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers import assert_close

import difffilter as df
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.hiding import HIDDEN, Hiding
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.batch import run
from difffilter.running.objectives import sum_losses
from difffilter.running.problem import Problem
from difffilter.scoring.hiding import hide_ahead, hide_channels, per_sensor
from difffilter.sensors.builtin import Position

D = torch.float64
RECIPE = Filter(
    ConstantVelocity(1, acceleration=0.5),
    (Position(axes=1, sigma=1.0), Position(name="other", axes=1, sigma=2.0)),
    df.huber,
)


def log_of(rows: int = 30) -> Log:
    generator = torch.Generator().manual_seed(3)
    z = torch.randn(rows, 2, generator=generator, dtype=D) + torch.arange(rows).unsqueeze(-1)
    z[4, 1] = torch.nan
    start = Start(torch.zeros(2, dtype=D), 4.0 * torch.eye(2, dtype=D))
    return Log(RECIPE.channels, torch.arange(rows, dtype=D), z, start=start)


def test_each_channel_from_the_other() -> None:
    log = log_of()
    hidden = hide_channels(log)
    assert hidden.z.shape == (30, 2, 2)
    track = run(Hiding(RECIPE), hidden)
    for i in (0, 1):
        z = log.z.clone()
        z[:, i] = torch.nan
        alone = run(RECIPE, replace(log, z=z))
        assert_close(track.mean[:, i], alone.mean, 1e-12)
        assert_close(track.covariance[:, i], alone.covariance, 1e-12)
        both = run(RECIPE, log.rows(0, 1))
        assert track.record is not None
        assert both.record is not None
        assert_close(track.record.innovation[0, i, i], both.record.innovation[0, i], 1e-12)
        present = track.record.present[:, i]
        assert torch.equal(present[:, i], ~torch.isnan(log.z[:, i]))
        assert not present[:, 1 - i].any()
        # one step on, by hand
        gap = log.z[9, i] - (alone.mean[8, 0] + alone.mean[8, 1])
        assert_close(track.record.innovation[9, i, i], gap, 1e-12)


def test_windows_are_of_each_trajectorys_own_times() -> None:
    """Rows twice as far apart: half as many in each window."""
    log = log_of(12)
    time = torch.stack([log.time, 2.0 * log.time], 1)
    assert log.start is not None
    start = Start(log.start.mean.expand(2, -1), log.start.covariance)
    pair = replace(log, time=time, z=log.z.unsqueeze(1).expand(-1, 2, -1), start=start)
    mask = hide_ahead(pair, 4.0, parts=2).inputs[HIDDEN][..., 0].reshape(12, 2, 2)
    slow, fast = (torch.floor(t / 4.0) for t in time.unbind(1))
    for part in (0, 1):
        for b, window in enumerate((slow, fast)):
            expected = ((window % 2 == part) & (window > 0)).to(D)
            assert torch.equal(mask[:, part, b], expected)


def test_windows_are_foretold() -> None:
    """Every row is hidden once, but for the first window: that has nothing before it."""
    hidden = hide_ahead(log_of(), 3.0, parts=3)
    mask = hidden.inputs[HIDDEN]
    assert mask.shape == (30, 3, 2)
    assert torch.equal(mask.sum((1, 2)), torch.tensor([0.0] * 3 + [2.0] * 27, dtype=D))
    track = run(Hiding(RECIPE), hidden)
    at = track.mean[2, 1]  # rows 3 to 5 are hidden in the second part
    assert track.record is not None
    for ahead in (1, 2, 3):
        gap = log_of().z[2 + ahead, 0] - (at[0] + ahead * at[1])
        assert_close(track.record.innovation[2 + ahead, 1, 0], gap, 1e-12)


def test_both_engines_sum_the_same() -> None:
    """Sums of a loss and their derivatives."""
    values = {n: v.requires_grad_() for n, v in RECIPE.published().items() if n != "huber.k"}
    problem = Problem(Hiding(RECIPE), hide_channels(log_of()), {"likelihood": 1.0})
    torch_, fused = (sum_losses(replace(problem, engine=e), values) for e in ("torch", "fused"))
    assert_close(fused.values, torch_.values.detach(), 1e-9)
    assert_close(fused.tangents, torch_.tangents, 1e-9)


def test_what_cannot_be_hidden_is_told() -> None:
    log = log_of()
    with pytest.raises(InputError, match="found no input hidden"):
        run(Hiding(RECIPE), log)
    with pytest.raises(InputError, match="found one"):
        hide_channels(log, ((0, 1),))
    with pytest.raises(InputError, match="more than 4 windows of 10 s"):
        hide_ahead(log, 10.0)
    with pytest.raises(InputError, match="found 0"):
        hide_ahead(log, 0.0)
    assert per_sensor(RECIPE) == ((0,), (1,))
