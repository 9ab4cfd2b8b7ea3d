"""What a loss for tuning is: one name, a sum over rows, and a function of that sum.

A sum over rows is what any engine can form, row by row, with its gradient alone kept; the
function of the sum is small and differentiated by autograd.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

import torch
from torch import Tensor

from difffilter.logs.log import Rows
from difffilter.logs.track import Track
from difffilter.registry import NAME, Registry
from difffilter.scoring.differences import Score, scored_difference, scored_rows

__all__ = ["LOSSES", "Added", "Loss", "LossContext", "log_mean", "loss", "mean", "with_scenes"]

#: Input that tells which rows are of which scene.
MEMBERS = "scenes.members"


@dataclass(frozen=True)
class LossContext:
    """What a loss may need beside track and log.

    Attributes:
        score: which rows count, as for :func:`difffilter.scoring.metrics.scored_rows`.
        scenes: first and last step of each scene, for ``scenes``.
        degrees: degrees of freedom of the Student density of ``likelihood``.
    """

    score: Score | str = "all"
    scenes: tuple[tuple[int, int], ...] = ()
    degrees: float = 4.0


#: (T, ..., q) of track, rows and context: what each row adds to q sums.
Added = Callable[[Track, Rows, LossContext], Tensor]


@dataclass(frozen=True)
class Loss:
    """A named loss.

    Attributes:
        rows: what each row adds to q sums.
        value: the loss of those sums (q,).
        needs_truth: whether the rows must have truth.
        meaning: one line.
        residuals: (T, ..., e) whose squares are what ``rows`` adds to the first sum, for
            Gauss-Newton; None for sums of another kind.
        curved: whether Gauss-Newton knows the curvature without residuals: a smooth scalar
            function of means.
        setting: what it needs that a log alone does not give, in words; empty for nothing.
        slopes: (B,), how the loss rises with each trajectory's squares, from its slope towards
            the sums and the log's inputs; None where it is that of the first sum for all.
    """

    rows: Added
    value: Callable[[Tensor], Tensor]
    needs_truth: bool
    meaning: str
    residuals: Added | None = None
    curved: bool = False
    setting: str = ""
    slopes: Callable[[Tensor, Mapping[str, Tensor]], Tensor] | None = None

    def __call__(self, track: Track, log: Rows, context: LossContext) -> Tensor:
        """The loss of a whole track."""
        added = self.rows(track, with_scenes(log, context), context)
        return self.value(added.flatten(0, -2).sum(0))


@lru_cache(maxsize=64)
def _of_state(name: str) -> Loss | None:
    """The loss ``error-STATE``; None for another name."""
    state = name.removeprefix(ERROR)
    if state == name or not NAME.fullmatch(state):
        return None

    def error(track: Track, log: Rows, context: LossContext) -> Tensor:
        rows = scored_rows(log, track, context.score).unsqueeze(-1)
        alone = Score(states=(state,))
        return torch.where(rows, scored_difference(log, track, alone), 0.0)

    return Loss(
        rows=_of_squares(error, needs_truth=True),
        value=log_mean,
        needs_truth=True,
        meaning=f"log of the mean squared error of {state}",
        residuals=error,
    )


#: Names of the losses of one state's error: this before its name.
ERROR = "error-"
#: Every loss by name; ``error-STATE`` is one for every state.
LOSSES: Registry[Loss] = Registry("loss", family=_of_state, called=f"{ERROR}STATE")


def with_scenes(log: Rows, context: LossContext) -> Rows:
    """The log with the input that says which rows are of which scene, (T, 1..., scenes)."""
    if not context.scenes or MEMBERS in log.inputs:
        return log
    step = torch.arange(1, log.steps + 1)
    inside = [(step >= first) & (step <= last) for first, last in context.scenes]
    members = torch.stack(inside, dim=-1).to(log.z.dtype)
    members = members.reshape(log.steps, *(1,) * (log.z.dim() - 2), len(context.scenes))
    return replace(log, inputs={**log.inputs, MEMBERS: members})


def log_mean(sums: Tensor) -> Tensor:
    """log of the mean, of (sum, count): its minimum is the mean's, free of its scale.

    An exact fit has the smallest number there is, and no gradient.
    """
    return (sums[0] / sums[1]).clamp_min(torch.finfo(sums.dtype).tiny).log()


def mean(sums: Tensor) -> Tensor:
    """The mean, of (sum, count); 0 where nothing counts."""
    return sums[0] / sums[1].clamp_min(1.0)


def loss(
    name: str,
    *,
    value: Callable[[Tensor], Tensor] | None = None,
    squares: bool = False,
    residuals: Added | None = None,
    slopes: Callable[[Tensor, Mapping[str, Tensor]], Tensor] | None = None,
    needs_truth: bool = False,
    curved: bool = False,
    setting: str = "",
    meaning: str = "",
) -> Callable[[Added], Added]:
    """Register a loss; the function goes on to be what it was.

    Args:
        name: in ``[tuning.loss]``, ``--loss`` and ``settings``.
        value: the loss of the sums (q,); the mean of (sum, count) if None, and of squares
            its log.
        squares: the function gives residuals (T, ..., e) in place of what rows add, 0 where
            nothing counts: Gauss-Newton works on them. What rows add is then their squares,
            and 1 for each scored row (each measured row, for a loss without truth).
        residuals, slopes, needs_truth, curved, setting, meaning: as for :class:`Loss`.

    Raises:
        InputError: a name that is taken, or is none.

    Example:
        >>> @loss("speed", squares=True, needs_truth=True, meaning="log of squared speed error")
        ... def speed(track, log, context):
        ...     own, true = track.states.index("vx"), log.truth_states.index("vx")
        ...     return track.mean[..., [own]] - log.truth[..., [true]]
    """

    def add(function: Added) -> Added:
        rows = _of_squares(function, needs_truth) if squares else function
        chosen = value or (log_mean if squares else mean)
        made = Loss(
            rows=rows,
            value=chosen,
            needs_truth=needs_truth,
            meaning=meaning,
            residuals=function if squares else residuals,
            curved=curved,
            setting=setting,
            slopes=slopes,
        )
        LOSSES.add(name, made)
        return function

    return add


def _of_squares(residuals: Added, needs_truth: bool) -> Added:
    def rows(track: Track, log: Rows, context: LossContext) -> Tensor:
        squared = residuals(track, log, context).square().sum(-1)
        count = scored_rows(log, track, context.score) if needs_truth else log.measured
        return torch.stack([squared, count.to(squared.dtype)], dim=-1)

    return rows
