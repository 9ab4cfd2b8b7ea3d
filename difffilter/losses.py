"""Losses for tuning: each is one name and one function of (track, log)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.log import Log
from difffilter.metrics import Score, mean_nees, position_error, scored_rows
from difffilter.run import Track

__all__ = ["LOSSES", "Loss", "LossContext", "total_loss"]


#: A scene that gets worse costs eight times what its mean of four scenes gains.
HINGE = 2.0


@dataclass(frozen=True)
class LossContext:
    """What a loss may need beside track and log.

    Attributes:
        score: which rows count, as for :func:`difffilter.metrics.scored_rows`.
        scenes: first and last step of each scene, for ``scenes``.
        degrees: degrees of freedom of the Student density of ``likelihood``.
    """

    score: Score | str = "all"
    scenes: tuple[tuple[int, int], ...] = ()
    degrees: float = 4.0


@dataclass(frozen=True)
class Loss:
    """A named loss: needs truth or not, and the function."""

    function: Callable[[Track, Log, LossContext], Tensor]
    needs_truth: bool
    meaning: str


def _position(track: Track, log: Log, context: LossContext) -> Tensor:
    """log of the mean squared position error: the minimum of the MSE, free of its scale."""
    rows = scored_rows(log, track, context.score)
    squared = torch.where(rows, position_error(log, track), 0.0)
    return (squared.sum() / rows.sum()).log()


def _likelihood(track: Track, log: Log, context: LossContext) -> Tensor:
    """Mean negative log density of the nominal innovations, Student's t with few degrees.

    The scale is the nominal sqrt(S_ii): the reweighted one would reward rejecting
    everything. Heavy tails keep outliers from inflating it.
    """
    record = track.record
    if record is None:
        raise InputError("likelihood: expected a filter with records")
    nu = context.degrees
    variance = record.innovation_variance
    constant = math.lgamma((nu + 1.0) / 2.0) - math.lgamma(nu / 2.0) - 0.5 * math.log(nu * math.pi)
    ratio = record.innovation.square() / (nu * variance)
    density = 0.5 * variance.log() + 0.5 * (nu + 1.0) * ratio.log1p() - constant
    present = record.present
    return torch.where(present, density, 0.0).sum() / present.sum().clamp_min(1)


def _consistency(track: Track, log: Log, context: LossContext) -> Tensor:
    """Zero where errors are as large as claimed: the mean NEES per state is 1."""
    rows = scored_rows(log, track, context.score)
    return _departure(mean_nees(log, track, rows))


def _innovation_consistency(track: Track, log: Log, context: LossContext) -> Tensor:
    """Zero where the mean nominal NIS per present channel is 1. Needs no truth."""
    record = track.record
    if record is None:
        raise InputError("innovation-consistency: expected a filter with records")
    return _departure(record.nis.sum() / record.present.sum().clamp_min(1))


def _scenes(track: Track, log: Log, context: LossContext) -> Tensor:
    """Mean over scenes of log RMSE, and a hinge on each that is worse than published.

    The published filter's squared errors on the same trajectories are the log's input
    ``reference.squared`` (T, ...), which tuning puts there.
    """
    if not context.scenes or "reference.squared" not in log.inputs:
        raise InputError("loss scenes: needs a scenario with [[scenes]], whole trajectories")
    rows, squared = scored_rows(log, track, context.score), position_error(log, track)
    logs, hinges = [], []
    for first, last in context.scenes:
        here = slice(first - 1, last)
        count = rows[here].sum()
        own = torch.where(rows[here], squared[here], 0.0).sum() / count
        reference = torch.where(rows[here], log.inputs["reference.squared"][here], 0.0).sum()
        logs.append(0.5 * own.log())
        hinges.append((0.5 * (own * count / reference).log()).clamp_min(0.0))
    return torch.stack(logs).mean() + HINGE * torch.stack(hinges).sum()


def _departure(ratio: Tensor) -> Tensor:
    """sqrt(1 + log(ratio)^2) - 1: quadratic near 1, and far off no steeper than the error.

    A plain square would make a filter whose model is wrong inflate its noise before
    anything else.
    """
    return (1.0 + ratio.log().square()).sqrt() - 1.0


#: Every loss by name.
LOSSES: Mapping[str, Loss] = {
    "position": Loss(_position, True, "log of the mean squared position error"),
    "likelihood": Loss(_likelihood, False, "robust negative log-likelihood of innovations"),
    "consistency": Loss(_consistency, True, "departure of the mean NEES per state from 1"),
    "scenes": Loss(_scenes, True, "mean log RMSE of the scenes, none worse than published"),
    "innovation-consistency": Loss(
        _innovation_consistency, False, "departure of the mean NIS per channel from 1"
    ),
}


def total_loss(
    weights: Mapping[str, float], track: Track, log: Log, context: LossContext
) -> tuple[Tensor, dict[str, Tensor]]:
    """Weighted sum of the named losses, and each term before weighting.

    Raises:
        InputError: an unknown name, or truth needed that the log does not have.
    """
    terms = {}
    for name in weights:
        if name not in LOSSES:
            raise InputError(f"loss: found {name!r}, expected one of {', '.join(LOSSES)}")
        if LOSSES[name].needs_truth and log.truth is None:
            free = ", ".join(n for n, loss in LOSSES.items() if not loss.needs_truth)
            raise InputError(f"loss {name}: needs truth columns, found none; without: {free}")
        terms[name] = LOSSES[name].function(track, log, context)
    total = sum((weights[name] * term for name, term in terms.items()), torch.zeros(()))
    return torch.as_tensor(total), terms
