"""The tracker's delayed output against the smoother with a lag."""

from __future__ import annotations

import pytest
import torch
from helpers import assert_close

import difffilter as df
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.robust.recovery import Recovery
from difffilter.running.fixed_lag import FixedLag
from difffilter.running.smoothing import smooth
from difffilter.running.tracker import Tracker
from difffilter.sensors.builtin import Position

D = torch.float64
KINDS: dict[str, dict[str, object]] = {
    "huber": {"weight": df.huber},
    "inflated": {"weight": df.tukey, "recovery": Recovery("inflate", rejections=2.0)},
    "weighed prior": {"weight": df.huber, "iterations": 2, "weigh_prior": True},
}


@pytest.mark.parametrize("kind", KINDS)
def test_delayed_rows_are_the_smoothers(kind: str) -> None:
    recipe = Filter(ConstantVelocity(1), (Position(axes=1, sigma=2.0),), **KINDS[kind])  # type: ignore[arg-type]
    generator = torch.Generator().manual_seed(2)
    dt = 0.25 * torch.randint(1, 6, (25,), generator=generator).to(D)
    z = dt.cumsum(0).unsqueeze(-1) + 2.0 * torch.randn(25, 1, generator=generator, dtype=D)
    z[12:] += 40.0
    z[4] = torch.nan
    start = Start(torch.tensor([0.0, 1.0], dtype=D), 4.0 * torch.eye(2, dtype=D), 0.0)
    log = Log(recipe.channels, dt.cumsum(0), z, start=start)
    for lag in (0.0, 1.5, 1e6):
        expected = smooth(recipe, log, lag=lag)
        late = FixedLag(Tracker(recipe, start.mean, start.covariance), lag)  # type: ignore[arg-type]
        found, waited = [], 0
        for row, interval in zip(z, dt.tolist(), strict=True):
            _, now = late.step(row, interval)
            found += now
            waited += len(now)
        found += late.flush()
        assert [row.time for row in found] == log.time.tolist()
        assert_close(torch.stack([row.mean for row in found]), expected.mean, 1e-9)
        assert_close(torch.stack([row.covariance for row in found]), expected.covariance, 1e-9)
        assert (waited > 0) is (lag < 100.0)
        assert late.flush() == []


def test_what_has_no_lag_is_told() -> None:
    recipe = Filter(ConstantVelocity(1), (Position(axes=1),))
    mean, covariance = [0.0, 0.0], [[1.0, 0.0], [0.0, 1.0]]
    with pytest.raises(InputError, match="lag: found -1"):
        FixedLag(Tracker(recipe, mean, covariance), -1.0)
    with pytest.raises(InputError, match="with history"):
        FixedLag(Tracker(recipe, mean, covariance, history=3.0), 1.0)
