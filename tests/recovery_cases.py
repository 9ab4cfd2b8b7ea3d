"""A jump that a narrow gate never believes, and filters that recover from it or do not."""

from __future__ import annotations

import torch
from helpers import linear_filter, tensor
from torch import Tensor

from difffilter.core.beliefs import Belief
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.robust.gate import Gate
from difffilter.robust.recovery import STREAK, Recovery
from difffilter.sensors.builtin import Position

ROWS, JUMP, AT = 120, 100.0, 30
TRUTH = JUMP * (torch.arange(ROWS) >= AT).double()
RECOVERIES = {"widen": Recovery("widen"), "inflate": Recovery("inflate")}


def axis_filter(recovery: Recovery | None = None, **options: object) -> Filter:
    """A position on one axis, little process noise and a gate that rejects."""
    sensor = Position(axes=1, sigma=1.0, channels=("p",))
    motion = ConstantVelocity(1, acceleration=0.03)
    chosen: dict[str, object] = {"gate": Gate("reject"), "recovery": recovery} | options
    return Filter(motion, (sensor,), **chosen)  # type: ignore[arg-type]


def jump_log(*, rows: int = ROWS, gap: slice = slice(0, 0)) -> Log:
    """Noise of 1 m about a position that jumps once; no measurement in the gap."""
    noise = torch.randn(ROWS, 1, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    z = noise + TRUTH.unsqueeze(-1)
    z[gap] = torch.nan
    start = Start(tensor([0.0, 0.0]), torch.eye(2).double(), 0.0)
    return Log(("p",), torch.arange(1.0, rows + 1).double(), z[:rows], start=start)


def after_rejections(state: Belief, count: float, groups: int = 3) -> Belief:
    """The belief with so many rejected rows of every group behind it."""
    streak = state.mean.new_full((*state.mean.shape[:-1], groups), count)
    return Belief(state.mean, state.deviations, {STREAK: streak})


def three_channels(**options: object) -> Filter:
    """Three linear channels whose noise is partly common (a full covariance)."""
    noise = ((1.0, 0.4, 0.2), (0.4, 2.0, 0.3), (0.2, 0.3, 1.5))
    return linear_filter(noise, **options)


def soft_values(filter: Filter, *names: str) -> dict[str, Tensor]:
    """Declared values, those named as leaves."""
    values = filter.published()
    return {k: v.requires_grad_() if k in names else v for k, v in values.items()}
