"""Systems of the scenarios with short logs: gaps, irregular times, three trajectories."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import lru_cache

import torch
from helpers import assert_close
from torch import Tensor

from difffilter import Filter, Log, load_scenario, simulate, started
from difffilter.filters.recipe import Recipe
from difffilter.running.batch import run
from difffilter.running.objectives import Problem, objective
from difffilter.scoring.losses import LossContext
from difffilter.scoring.metrics import position_error

#: Losses that are mixed, so that no term hides behind another.
LOSSES = {"position": 1.0, "likelihood": 0.3, "consistency": 0.5, "innovation-consistency": 0.2}
SCENES = LossContext(scenes=((2, 8), (9, 15)))


def irregular(log: Log, seed: int = 4) -> Log:
    """Every tenth measurement missing, one row without any, intervals 20 % up and down."""
    generator = torch.Generator().manual_seed(seed)
    missing = torch.rand(log.z.shape, generator=generator) < 0.1
    missing[3] = True
    z = torch.where(missing, torch.nan, log.z)
    stretch = 0.8 + 0.4 * torch.rand(log.steps, generator=generator, dtype=torch.float64)
    dt = torch.diff(log.time, dim=0, prepend=log.time[:1])
    time = log.time[:1] + (stretch.reshape(-1, *[1] * (dt.dim() - 1)) * dt).cumsum(0)
    return replace(log, z=z, time=time, start=log.start)


@lru_cache(maxsize=4)
def short_log(
    name: str, system: str, overrides: tuple[tuple[str, object], ...] = (), steps: int = 16
) -> tuple[Filter, Log]:
    """A system of a scenario and its log."""
    scenario = load_scenario(name, dict(overrides))
    filter = scenario.system(system)
    assert isinstance(filter, Recipe)
    log = started(scenario, filter, simulate(scenario, 3, seed=3))
    return filter, irregular(replace(log.rows(0, steps), start=log.start))


def with_reference(filter: Filter, log: Log) -> Log:
    """What the loss over scenes compares with: the published filter, made a tenth better."""
    with torch.no_grad():
        squared = 0.81 * position_error(log, run(filter, log, engine="torch")).square()
    return replace(log, inputs={**log.inputs, "reference.squared": squared})


def leaves(filter: Filter) -> dict[str, Tensor]:
    """Published values that require a gradient."""
    return {name: value.clone().requires_grad_() for name, value in filter.published().items()}


def value_and_gradient(
    filter: Filter,
    log: Log,
    losses: Mapping[str, float],
    temperature: float | None,
    engine: str,
    context: LossContext | None = None,
) -> tuple[float, Tensor]:
    """The objective at the published values, and its gradient towards all of them."""
    values = leaves(filter)
    problem = Problem(
        filter,
        log,
        losses,
        context=context or LossContext(),
        temperature=temperature,
        engine=engine,
    )
    total, _ = objective(problem, values)
    found = torch.autograd.grad(total, list(values.values()), allow_unused=True)
    flat = [
        torch.zeros_like(v) if g is None else g for v, g in zip(values.values(), found, strict=True)
    ]
    return float(total.detach()), torch.cat([g.reshape(-1) for g in flat])


def assert_same_gradient(
    filter: Filter,
    log: Log,
    temperature: float | None = None,
    losses: Mapping[str, float] = LOSSES,
    context: LossContext | None = None,
) -> None:
    """Both engines: the value to 1e-9, the gradient to 1e-7 of its largest entry."""
    slow, fast = (
        value_and_gradient(filter, log, losses, temperature, engine, context)
        for engine in ("torch", "fused")
    )
    assert abs(fast[0] - slow[0]) <= 1e-9 * max(abs(slow[0]), 1.0)
    assert slow[1].isfinite().all()
    assert float(slow[1].abs().max()) > 0.0
    assert_close(fast[1], slow[1], 1e-7)
