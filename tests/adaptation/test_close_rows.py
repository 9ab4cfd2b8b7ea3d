"""Correction and fusion on clean data whose rows lie close together, or in pairs."""

from __future__ import annotations

import pytest
import torch
from helpers import tensor
from torch import Tensor

from difffilter.adaptation.chain import Chain
from difffilter.adaptation.correction import PredictionCorrection
from difffilter.adaptation.matching import InnovationMatching
from difffilter.filters.filter import Filter
from difffilter.filters.fusion import Fusion
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.batch import run
from difffilter.sensors.builtin import Position

ROWS, TARGETS = 120, 12
MOTION = ConstantVelocity()
ONE = (Position(sigma=2.0),)
THREE = tuple(Position(name=name, sigma=2.0) for name in "abc")
FILTERS = {
    "correction": Filter(MOTION, ONE, adaptation=PredictionCorrection()),
    "chain": Filter(MOTION, ONE, adaptation=Chain((InnovationMatching(), PredictionCorrection()))),
    "fusion": Fusion(MOTION, THREE),
}


def times(kind: str, spacing: float) -> Tensor:
    if kind == "uniform":
        return spacing * torch.arange(ROWS).double()
    pairs = max(0.5, 2.0 * spacing) * torch.arange(ROWS // 2).double().repeat_interleave(2)
    pairs[1::2] += spacing
    return pairs


def rmse(filter: Filter, time: Tensor) -> float:
    truth = torch.stack([10.0 * time, 0.0 * time], dim=-1).unsqueeze(1)
    seed = torch.Generator().manual_seed(1)
    noise = torch.randn(ROWS, TARGETS, 6, generator=seed, dtype=torch.float64)
    count = len(filter.channels)
    z = truth.repeat(1, 1, count // 2) + 2.0 * noise[..., :count]
    start = Start(tensor([0.0, 0.0, 10.0, 0.0]), 4.0 * torch.eye(4).double(), 0.0)
    track = run(filter, Log(filter.channels, time, z), start=start, engine="torch")
    return float((track.mean[..., :2] - truth).square().sum(-1).mean().sqrt())


@pytest.mark.parametrize("kind", ["uniform", "pairs"])
@pytest.mark.parametrize("spacing", [1e-6, 1e-3, 0.1, 1.0, 10.0])
@pytest.mark.parametrize("name", list(FILTERS))
def test_clean_data_is_followed_as_by_the_plain_filter(
    name: str, spacing: float, kind: str
) -> None:
    filter, time = FILTERS[name], times(kind, spacing)
    assert rmse(filter, time) < 1.2 * rmse(Filter(MOTION, filter.sensors), time)


def test_pairs_of_rows_one_hundredth_of_a_second_apart() -> None:
    time = torch.arange(100).double().repeat_interleave(2) * 0.5
    time[1::2] += 0.01
    path = torch.stack([10.0 * time, 0.0 * time], dim=-1)
    seed = torch.Generator().manual_seed(1)
    z = path + 2.0 * torch.randn(200, 2, generator=seed, dtype=torch.float64)
    start = Start(tensor([0.0, 0.0, 10.0, 0.0]), 4.0 * torch.eye(4).double())
    errors = []
    for filter in (Filter(MOTION, ONE), FILTERS["chain"]):
        track = run(filter, Log(filter.channels, time, z), start=start, engine="torch")
        errors.append(float((track.mean[..., :2] - path).square().sum(-1).mean().sqrt()))
    assert errors[1] < 1.2 * errors[0]
