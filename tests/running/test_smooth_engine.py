"""The compiled way back against torch's."""

from __future__ import annotations

import pytest
import torch
from helpers import assert_close

import difffilter as df
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.smoothing import smooth
from difffilter.sensors.builtin import Position, Range

D = torch.float64
STATIONS = ((0.0, 0.0), (60.0, 0.0), (0.0, 60.0))


@pytest.mark.parametrize("lead", [(), (3,)])
def test_engines_agree(lead: tuple[int, ...]) -> None:
    """Singular starts, gaps, rows at one time, weights, inputs; one log and several."""
    generator = torch.Generator().manual_seed(5)
    recipe = Filter(
        ConstantVelocity(2, acceleration=0.7, noise_kind="discrete"),
        (Position(sigma=3.0), Range(stations=STATIONS, sigma=2.0)),
        df.huber,
    )
    rows = 60
    time = torch.rand(rows, generator=generator, dtype=D).cumsum(0)
    time[4] = time[3]
    z = 20.0 + 5.0 * torch.randn(rows, *lead, 5, generator=generator, dtype=D)
    z[torch.rand(z.shape, generator=generator) < 0.3] = torch.nan
    known = torch.tensor([9.0, 0.0, 4.0, 0.0], dtype=D)
    start = Start(torch.full((4,), 15.0, dtype=D), torch.diag(known))
    log = Log(recipe.channels, time, z)
    found = smooth(recipe, log, start=start, engine="fused")
    expected = smooth(recipe, log, start=start, engine="torch")
    assert_close(found.mean, expected.mean, 1e-9)
    assert_close(found.covariance, expected.covariance, 1e-9)
