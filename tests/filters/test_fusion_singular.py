"""Distributed fusion from a start that is known exactly, in part or altogether."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers import assert_close, tensor

from difffilter.filters.filter import Filter
from difffilter.filters.fusion import Fusion
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.batch import run
from difffilter.sensors.builtin import Position

KNOWN = {
    "velocity known": torch.diag(tensor([25.0, 25.0, 0.0, 0.0])),
    "all known": torch.zeros(4, 4).double(),
    "one direction": torch.ones(4, 4).double(),
}


def case() -> tuple[Filter, Log]:
    sensors = tuple(Position(name=name, sigma=2.0) for name in "abc")
    filter = Fusion(ConstantVelocity(), sensors)
    time = 0.5 * torch.arange(20).double()
    path = torch.stack([10.0 * time, 0.0 * time], dim=-1).repeat(1, 3)
    noise = torch.randn(20, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return filter, Log(filter.channels, time, path + 2.0 * noise)


@pytest.mark.parametrize("known", list(KNOWN))
def test_a_start_without_variance_is_a_start(known: str) -> None:
    filter, log = case()
    singular = Start(tensor([0.0, 0.0, 10.0, 0.0]), KNOWN[known], 0.0)
    nearly = replace(singular, covariance=KNOWN[known] + 1e-10 * torch.eye(4).double())
    found, expected = (run(filter, log, start=x, engine="torch") for x in (singular, nearly))
    assert_close(found.mean, expected.mean, 1e-6)
    assert_close(found.covariance, expected.covariance, 1e-6)


@pytest.mark.parametrize("known", list(KNOWN))
def test_its_gradient_is_finite(known: str) -> None:
    filter, log = case()
    values = {name: x.requires_grad_() for name, x in filter.published().items()}
    start = Start(tensor([0.0, 0.0, 10.0, 0.0]), KNOWN[known], 0.0)
    track = run(filter, log, values, start, temperature=0.3)
    total = track.mean.square().sum() + track.covariance.sum()
    for gradient in torch.autograd.grad(total, list(values.values())):
        assert bool(torch.isfinite(gradient).all())
