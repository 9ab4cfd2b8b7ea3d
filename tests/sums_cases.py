"""Sums of losses by both engines."""

from __future__ import annotations

import torch
from engine_cases import LOSSES, irregular, leaves

from difffilter import Filter, Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.objectives import Problem, Sums, sum_losses
from difffilter.scoring.losses import LossContext
from difffilter.sensors.position import Position
from difffilter.weights.registry import tanh


def summed(
    filter: Filter,
    log: Log,
    engine: str,
    losses: dict[str, float] = LOSSES,
    context: LossContext | None = None,
    temperature: float | None = 0.3,
) -> Sums:
    context = context or LossContext()
    problem = Problem(filter, log, losses, context=context, temperature=temperature, engine=engine)
    return sum_losses(problem, leaves(filter))


def plane(batch: int = 9) -> tuple[Filter, Log]:
    filter = Filter(
        ConstantVelocity(2, acceleration=0.8), (Position(sigma=1.0),), tanh, start_sigma=1.5
    )
    generator = torch.Generator().manual_seed(1)
    steps = 14
    truth = torch.randn(steps, batch, 2, generator=generator, dtype=torch.float64).cumsum(0)
    z = truth + 2.0 * torch.randn(truth.shape, generator=generator, dtype=torch.float64)
    begin = Start(torch.cat([truth[0], torch.zeros(batch, 2).double()], -1))
    time = torch.arange(steps).double()
    return filter, irregular(Log(filter.channels, time, z, truth, ("x", "y"), start=begin))
