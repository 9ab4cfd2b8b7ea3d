"""A start that is off is off in the errors of the state, whatever the state is."""

from __future__ import annotations

import torch
from attitude_cases import attitude

import difffilter as df
from difffilter.motions import quaternion
from difffilter.verdict.changed_logs import moved_start

SIGMA = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)


def test_an_attitude_is_turned_by_sigmas_and_stays_a_rotation() -> None:
    recipe = attitude({"a": (0.0, 0.0, 9.81), "m": (0.4, 0.0, 0.9)}, 0.05, (0.2, 0.2))
    begin = quaternion.exponential(torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64))
    time = torch.arange(1, 4, dtype=torch.float64)
    none = torch.zeros(3, 2, dtype=torch.float64)
    log = df.Log(
        recipe.channels,
        time,
        torch.zeros(3, 2, 6, dtype=torch.float64),
        inputs={"wx": none, "wy": none, "wz": none},
        start=df.Start(begin.expand(2, -1), torch.diag(SIGMA.square()).expand(2, 3, 3), 0.0),
    )
    found = moved_start(recipe, log, 3.0, seed=1).start
    assert found is not None
    shift = quaternion.local(begin.expand(2, -1), found.mean)
    assert torch.allclose(shift.abs(), 3.0 * SIGMA.expand(2, -1), atol=1e-12)
    assert torch.allclose(found.mean.norm(dim=-1), torch.ones(2, dtype=torch.float64))


def test_errors_that_last_are_not_part_of_a_start_without_them() -> None:
    ranges = df.Range(stations=[(0.0, 0.0), (9.0, 0.0), (0.0, 9.0)], sigma=0.1, name="range")
    recipe = df.Filter(df.ConstantVelocity(2), (df.Lasting(ranges, common=(0.2, 1.4)),))
    time, z = torch.arange(1, 4).double(), torch.ones(3, 1, 3).double()
    start = df.Start(torch.ones(1, 4).double(), 4.0 * torch.eye(4).double().expand(1, 4, 4), 0.0)
    log = df.Log(recipe.channels, time, z, start=start)
    found = moved_start(recipe, log, 3.0, seed=1).start
    assert found is not None
    assert (found.mean - 1.0).abs().tolist() == [[6.0] * 4]
