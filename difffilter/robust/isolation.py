"""Isolation: a sensor with anything that is not finite is left out of the row."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from difffilter.core.linearised import Linearised
from difffilter.robust.groups import spread

__all__ = ["isolated"]


def isolated(
    members: Sequence[Sequence[int]], linear: Linearised, present: Tensor
) -> tuple[Linearised, Tensor, Tensor]:
    """Take out whole sensors with an innovation, a noise or a deviation that is not finite.

    Args:
        members: indices of each sensor's channels.
        linear, present: the step's.

    Returns:
        Both without those sensors, and which channels were left out (..., m).
    """
    finite = torch.isfinite(linear.innovation.square()) & torch.isfinite(linear.independent)
    finite = finite & torch.isfinite(linear.observed).all(-1)
    out = spread(members, [~finite[..., [*own]].all(-1) for own in members])
    sound = linear._replace(
        innovation=torch.where(out, 0.0, linear.innovation),
        observed=torch.where(out.unsqueeze(-1), 0.0, linear.observed),
        independent=torch.where(out, 1.0, linear.independent),
        total=torch.where(out, 1.0, linear.total),
    )
    return sound, present & ~out, out
