"""Which channels share one weight and one gate, and how far such a group is off."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from difffilter.core.conditioning import condition
from difffilter.core.linalg import positive_sqrt
from difffilter.errors import InputError

__all__ = ["DISTANCES", "SCOPES", "Scope", "channel_groups", "group_rms", "normalised_square"]

SCOPES = ("channel", "sensor", "all")
DISTANCES = ("rms", "mahalanobis")

#: ``channel``, ``sensor``, ``all``, or named groups of channels.
Scope = str | Mapping[str, Sequence[str]]


def channel_groups(
    scope: Scope, channels: Sequence[str], per_sensor: Sequence[int]
) -> tuple[tuple[int, ...], ...]:
    """Indices of each group's channels; a channel that no group names is one by itself.

    Args:
        scope: see :data:`Scope`.
        channels: names of all channels; per_sensor: how many each sensor has.

    Raises:
        InputError: an unknown scope, an unknown channel, a channel in two groups.
    """
    count = len(channels)
    if scope == "channel":
        return tuple((i,) for i in range(count))
    if scope == "all":
        return (tuple(range(count)),)
    if scope == "sensor":
        ends = [sum(per_sensor[: i + 1]) for i in range(len(per_sensor))]
        return tuple(tuple(range(e - m, e)) for e, m in zip(ends, per_sensor, strict=True))
    if isinstance(scope, str):
        expected = ", ".join(SCOPES)
        raise InputError(f"scope: found {scope!r}, expected one of {expected}, or named groups")
    groups, taken = [], set()
    for name, members in scope.items():
        for member in members:
            if member not in channels or member in taken:
                where = f"found {member!r}, expected channels among {', '.join(channels)}"
                raise InputError(f"scope.{name}: {where}, none twice")
            taken.add(member)
        if not members:
            raise InputError(f"scope.{name}: found no channel, expected one or more")
        groups.append(tuple(channels.index(member) for member in members))
    alone = [(i,) for i, name in enumerate(channels) if name not in taken]
    return (*groups, *alone)


def spread(groups: Sequence[Sequence[int]], per_group: Sequence[Tensor]) -> Tensor:
    """One number per group, each (...), to one per channel (..., m)."""
    place = {channel: g for g, group in enumerate(groups) for channel in group}
    return torch.stack([per_group[place[i]] for i in range(len(place))], dim=-1)


def group_rms(s: Tensor, present: Tensor, group: Sequence[int]) -> Tensor:
    """(...), root mean square of the group's present entries of s (..., m); 0 with none."""
    own = [*group]
    here = present[..., own]
    total = torch.where(here, s[..., own], 0.0).square().sum(-1)
    return positive_sqrt(total / here.sum(-1).clamp_min(1))


def normalised_square(
    residual: Tensor, observed: Tensor, noise: Tensor, present: Tensor, group: Sequence[int]
) -> Tensor:
    """(...), e^T (Z Z^T + diag r)^-1 e over the present channels of a group; 0 with none.

    Without an inverse: conditioning on the group alone gives y = Z^T S^-1 e as the shift of
    identity rows and diag(r) S^-1 e as the residual, and the square is y^T y + e'^T diag(r)^-1 e'
    with e' that residual.

    Args:
        residual: e (..., m); observed: Z (..., m, k); noise: r (..., m); present (..., m).
    """
    if not observed.shape[-1]:
        observed = torch.nn.functional.pad(observed, (0, 1))
    own, k = [*group], observed.shape[-1]
    here = present[..., own]
    rows = torch.eye(k, dtype=observed.dtype, device=observed.device)
    rows = rows.expand(*residual.shape[:-1], k, k)
    e = torch.where(here, residual[..., own], 0.0)
    r = torch.where(here, noise[..., own], 1.0)  # a full R has r = 0: keep 0 / 0 away
    done = condition(rows, observed[..., own, :], e, here.to(e.dtype), r)
    independent = (r > 0.0) & here
    left = torch.where(independent, done.residual, 0.0).square()
    total: Tensor = done.shift.square().sum(-1)
    return total + (left / torch.where(independent, r, 1.0)).sum(-1)
