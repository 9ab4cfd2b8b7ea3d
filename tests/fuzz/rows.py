"""Random logs as plain data: moderate ones, on which engines must agree, and hostile ones."""

from __future__ import annotations

import math
import random
from typing import Any

import torch
from torch import Tensor

from difffilter import Log, Start

Spec = dict[str, Any]

#: What a hostile log may have in it.
HAZARDS = (
    "dt-zero", "dt-tiny", "dt-huge", "gaps", "outliers", "nan-rows", "singular", "no-start-noise",
    "at-station", "far", "tiny-start", "dead-channel", "constant",
)  # fmt: skip


def draw(rng: random.Random, hostile: bool) -> Spec:
    """Of one case: seed, sizes and hazards."""
    count = rng.randint(1, 4) if hostile else 0
    return {
        "seed": rng.randrange(2**31),
        "steps": rng.choice((20, 60)),
        "trajectories": rng.choice((1, 512, 2048) if hostile else (1, 8)),
        "hazards": sorted(rng.sample(HAZARDS, count)),
        "float32": hostile and rng.random() < 0.3,
    }


def make(spec: Spec, recipe: Any) -> tuple[Log, Start]:
    """The log of a walk about (100, 150) at some m/s, and its start."""
    rng = torch.Generator().manual_seed(spec["seed"])
    dtype = torch.float32 if spec["float32"] else torch.float64
    steps, batch = spec["steps"], spec["trajectories"]
    hazards = set(spec["hazards"])

    def normal(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=rng, dtype=torch.float64)

    def some(share: float, *shape: int) -> Tensor:
        return torch.rand(*shape, generator=rng, dtype=torch.float64) < share

    time = _times(steps, hazards, some)
    offset = torch.tensor([5e5, 5.4e6] if "far" in hazards else [100.0, 150.0], dtype=torch.float64)
    if "at-station" in hazards:
        offset = torch.zeros(2).double()
    velocity = 3.0 * normal(batch, 2)
    path = offset + velocity * time.clamp_max(1e3)[:, None, None] + normal(steps, batch, 2)
    state = torch.cat([path, velocity.expand(steps, batch, 2)], dim=-1)
    z = _measured(recipe, state, normal)
    if "outliers" in hazards:
        size = 10.0 ** (12.0 * torch.rand(z.shape, generator=rng, dtype=torch.float64))
        z = torch.where(some(0.1, *z.shape), z + size * normal(*z.shape).sign(), z)
    if "constant" in hazards:
        z = z[:1].expand_as(z).clone()
    missing = some(0.1, *z.shape)
    if "gaps" in hazards:
        missing = missing | some(0.7, *z.shape)
    if "nan-rows" in hazards:
        missing = missing | some(0.3, steps, 1, 1)
    if "dead-channel" in hazards:
        missing[..., 0] = True
    z = torch.where(missing, math.nan, z)
    spread = torch.tensor([25.0, 25.0, 4.0, 4.0], dtype=torch.float64)
    if "singular" in hazards:
        spread = torch.tensor([25.0, 0.0, 4.0, 0.0], dtype=torch.float64)
    if "no-start-noise" in hazards:
        spread = torch.zeros(4).double()
    if "tiny-start" in hazards:
        spread = spread * 1e-12
    mean = state[0] + spread.sqrt() * normal(batch, 4)
    start = Start(mean.to(dtype), torch.diag(spread).expand(batch, 4, 4).to(dtype), float(time[0]))
    log = Log(recipe.channels, time.to(dtype), z.to(dtype))
    if dtype == torch.float32:  # equal times must stay in order
        log = Log(recipe.channels, time.to(dtype).cummax(0).values, z.to(dtype))
    return log, start


def _times(steps: int, hazards: set[str], some: Any) -> Tensor:
    dt = torch.ones(steps).double()
    if "dt-tiny" in hazards:
        dt = torch.where(some(0.3, steps), 1e-6, dt)
    if "dt-huge" in hazards:
        dt = torch.where(some(0.05, steps), 1e6, dt)
    if "dt-zero" in hazards:
        dt = torch.where(some(0.3, steps), 0.0, dt)
    return dt.cumsum(0)


def _measured(recipe: Any, state: Tensor, normal: Any) -> Tensor:
    values = recipe.published()
    constants = recipe.prepare(values)
    parts = []
    for sensor in recipe.sensors:
        predicted = sensor.predict(state, {}, constants)
        sigma = values[f"{sensor.name}.sigma"]
        sigma = sigma.diagonal().sqrt() if sigma.dim() == 2 else sigma
        parts.append(predicted + sigma * normal(*predicted.shape))
    return torch.cat(parts, dim=-1)
