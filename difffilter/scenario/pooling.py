"""Pooled sensors: one measurement from several that measure the same, by their information."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from difffilter.scenario.sensing import SensorSpec

__all__ = ["pooled", "pooled_sigma"]


def pooled_sigma(members: list[SensorSpec]) -> float:
    """Standard deviation of the mean weighted by information, all members present."""
    return float(sum(member.sigma**-2 for member in members) ** -0.5)


def pooled(
    sensors: Mapping[str, SensorSpec], channels: tuple[str, ...], z: Tensor
) -> tuple[Tensor, Tensor]:
    """Fill the channels of pooled sensors: z (..., m), and the weights (m, m) by rows.

    Each is the mean of its members' channels that are present, weighted by 1 / sigma^2 of the
    world; missing where all are. The weights are those with every member present.
    """
    weights = torch.eye(len(channels), dtype=z.dtype)
    columns = list(z.unbind(-1))
    for sensor in sensors.values():
        for i, name in enumerate(sensor.model.channels if sensor.pool else ()):
            members = [sensors[member] for member in sensor.pool]
            at = [channels.index(member.model.channels[i]) for member in members]
            level = torch.tensor([member.sigma**-2 for member in members], dtype=z.dtype)
            parts = z[..., at]
            present = ~torch.isnan(parts)
            total = (present * level).sum(-1)
            mean = (torch.nan_to_num(parts) * level).sum(-1) / torch.where(total > 0, total, 1.0)
            here = channels.index(name)
            columns[here] = torch.where(total > 0, mean, torch.nan)
            weights[here] = 0.0
            weights[here, at] = level / level.sum()
    return torch.stack(columns, dim=-1), weights
