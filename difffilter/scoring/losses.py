"""The losses for tuning that the library brings, and how several are weighed together."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.logs.log import Rows
from difffilter.logs.track import Track
from difffilter.scoring.differences import scored_difference, scored_rows
from difffilter.scoring.directions import nees_directions
from difffilter.scoring.foretelling import surprise
from difffilter.scoring.loss import (
    LOSSES,
    MEMBERS,
    Loss,
    LossContext,
    loss,
    mean,
    with_scenes,
)
from difffilter.scoring.metrics import nees, nees_states

__all__ = [
    "LOSSES",
    "Loss",
    "LossContext",
    "check_losses",
    "loss",
    "total_loss",
    "weighted",
    "with_scenes",
]

#: A scene that gets worse costs eight times what its mean of four scenes gains.
HINGE = 2.0
#: Log of an RMSE ratio within which a member's hinge is round: 1 %.
ROUND = 0.01
#: Input that ``scenes`` and ``worlds`` read beside the rows: squared errors to compare with.
REFERENCE = "reference.squared"
#: Inputs that ``worlds`` reads: membership, and this times weight and what is allowed.
WORLDS = ("worlds.members", "worlds.weight", "worlds.allow")


def _counted(value: Tensor, count: Tensor) -> Tensor:
    return torch.stack([value, count.to(value.dtype)], dim=-1)


def _departure(ratio: Tensor) -> Tensor:
    """sqrt(1 + log(ratio)^2) - 1: quadratic near 1, and far off no steeper than the error.

    A plain square would make a filter whose model is wrong inflate its noise before
    anything else.
    """
    ratio = ratio.clamp_min(torch.finfo(ratio.dtype).tiny)  # an exact fit
    return (1.0 + ratio.log().square()).sqrt() - 1.0


@loss(
    "position",
    squares=True,
    needs_truth=True,
    meaning="log of the mean squared position error (of the scored states, where they are others)",
)
def _scored_difference(track: Track, log: Rows, context: LossContext) -> Tensor:
    rows = scored_rows(log, track, context.score).unsqueeze(-1)
    return torch.where(rows, scored_difference(log, track, context.score), 0.0)


@loss("likelihood", meaning="robust negative log-likelihood of innovations")
def _likelihood_rows(track: Track, log: Rows, context: LossContext) -> Tensor:
    """Negative log density of the nominal innovations, Student's t with few degrees.

    The scale is the nominal sqrt(S_ii): the reweighted one would reward rejecting
    everything. Heavy tails keep outliers from inflating it.
    """
    record = track.record
    if record is None:
        raise InputError("likelihood: expected a filter with records")
    density = surprise(record.innovation, record.innovation_variance, context.degrees)
    density = torch.where(record.present, density, 0.0).sum(-1)
    return _counted(density, record.present.sum(-1))


@loss("normal-likelihood", meaning="negative log-likelihood of innovations, jointly normal")
def _normal_rows(track: Track, log: Rows, context: LossContext) -> Tensor:
    """Negative log density of the nominal innovations, jointly normal: nothing robust."""
    record = track.record
    if record is None:
        raise InputError("normal-likelihood: expected a filter with records")
    return _counted(-record.log_density, record.present.sum(-1))


def _consistency(sums: Tensor) -> Tensor:
    """Zero where errors are as large as claimed: the mean NEES per state is 1."""
    return _departure(sums[0] / sums[1])


@loss(
    "consistency",
    value=_consistency,
    needs_truth=True,
    curved=True,
    meaning="departure of the mean NEES per state from 1",
)
def _consistency_rows(track: Track, log: Rows, context: LossContext) -> Tensor:
    squared = nees(log, track)
    rows = scored_rows(log, track, context.score) & ~torch.isnan(squared)
    return _counted(torch.where(rows, squared, 0.0), rows * nees_states(log, track))


def _directions(sums: Tensor) -> Tensor:
    """Zero where the mean NEES along each principal direction is 1."""
    squared, count = sums.reshape(-1, 2).unbind(-1)
    return _departure(squared / count.clamp_min(1.0)).sum()


@loss(
    "direction-consistency",
    value=_directions,
    needs_truth=True,
    curved=True,
    meaning="departure of the mean NEES along each principal direction of the position from 1",
)
def _direction_rows(track: Track, log: Rows, context: LossContext) -> Tensor:
    rows = scored_rows(log, track, context.score)
    added = []
    for name, squared in nees_directions(log, track).items():
        if name.startswith("position"):
            known = rows & ~torch.isnan(squared)
            added += [torch.where(known, squared, 0.0), known.to(squared.dtype)]
    if not added:
        raise InputError("direction-consistency: found no true position, expected one")
    return torch.stack(added, dim=-1)


def _innovation_consistency(sums: Tensor) -> Tensor:
    """Zero where the mean nominal NIS per present channel is 1. Needs no truth."""
    return _departure(mean(sums))


@loss(
    "innovation-consistency",
    value=_innovation_consistency,
    curved=True,
    meaning="departure of the mean NIS per channel from 1",
)
def _innovation_consistency_rows(track: Track, log: Rows, context: LossContext) -> Tensor:
    record = track.record
    if record is None:
        raise InputError("innovation-consistency: expected a filter with records")
    return _counted(record.nis, record.present.sum(-1))


def _hinges(squared: Tensor, largest: Tensor) -> Tensor:
    """What scenes cost whose squared errors are larger than they may be."""
    return HINGE * (0.5 * (squared / largest).log()).clamp_min(0.0).sum()


def _smooth_hinges(squared: Tensor, largest: Tensor) -> Tensor:
    """The same of members, round within about ``ROUND``: with a kink no second-order step ends."""
    over = 0.5 * (squared / largest).log()
    return HINGE * 0.5 * (over + (over.square() + ROUND**2).sqrt()).sum()


def _scenes(sums: Tensor) -> Tensor:
    """Mean over scenes of log RMSE, and a hinge on each that is worse than published."""
    squared, reference, count = sums.reshape(-1, 3).unbind(-1)
    return 0.5 * (squared / count).log().mean() + _hinges(squared, reference)


def _worlds(sums: Tensor) -> Tensor:
    """Weighted mean of the members' log RMSE ratios, none worse than allowed."""
    squared, reference, weight, allow = sums.reshape(-1, 4).unbind(-1)
    seen = reference > 0.0  # a batch may hold nothing of a member
    squared, reference = squared[seen], reference[seen]
    weight, allow = weight[seen] / reference, allow[seen] / reference
    gain = (weight * 0.5 * (squared / reference).log()).sum() / weight.sum()
    return gain + _smooth_hinges(squared, reference * allow.square())


def _worlds_slopes(slope: Tensor, inputs: Mapping[str, Tensor]) -> Tensor:
    """(B,), by how much the loss rises with a trajectory's squared error."""
    return inputs[WORLDS[0]][0] @ slope.reshape(-1, 4)[:, 0]


@loss(
    "worlds",
    value=_worlds,
    needs_truth=True,
    curved=True,
    residuals=_scored_difference,
    slopes=_worlds_slopes,
    setting="simulated [[worlds]] of a scenario",
    meaning="mean log RMSE ratio to published over [[worlds]], none worse than allowed",
)
def _worlds_rows(track: Track, log: Rows, context: LossContext) -> Tensor:
    """Per member: squared errors, published ones, these times its weight, and times what it allows.

    Inputs of the log tell which trajectories belong to which member, and the last two (see
    :mod:`difffilter.tuning.worlds`).
    """
    if REFERENCE not in log.inputs or WORLDS[0] not in log.inputs:
        raise InputError("loss worlds: needs the simulated [[worlds]] of a scenario, in tuning")
    rows = scored_rows(log, track, context.score)
    squared = _scored_difference(track, log, context).square().sum(-1, keepdim=True)
    reference = torch.where(rows, log.inputs[REFERENCE], 0.0).unsqueeze(-1)
    members, weight, allow = (log.inputs[name] for name in WORLDS)
    added = (members * squared, members * reference, weight * reference, allow * reference)
    return torch.stack(added, dim=-1).flatten(-2)


@loss(
    "scenes",
    value=_scenes,
    needs_truth=True,
    setting="whole trajectories of a scenario with [[scenes]]",
    meaning="mean log RMSE of the scenes, none worse than published",
)
def _scenes_rows(track: Track, log: Rows, context: LossContext) -> Tensor:
    """Per scene: squared errors, those of the published filter on the same rows, rows.

    The published filter's are the log's input ``reference.squared`` (T, ...), which tuning
    puts there.
    """
    if not context.scenes or REFERENCE not in log.inputs:
        raise InputError("loss scenes: needs a scenario with [[scenes]], whole trajectories")
    rows = scored_rows(log, track, context.score)
    squared = _scored_difference(track, log, context).square().sum(-1)
    reference = torch.where(rows, log.inputs[REFERENCE], 0.0)
    added = torch.stack([squared, reference, rows.to(squared.dtype)], dim=-1)
    return (log.inputs[MEMBERS].unsqueeze(-1) * added.unsqueeze(-2)).flatten(-2)


def check_losses(weights: Mapping[str, float], log: Rows) -> None:
    """Raise InputError for an unknown name, or truth needed that the log does not have."""
    for name in weights:
        if LOSSES[name].needs_truth and log.truth is None:
            free = ", ".join(n for n, loss in LOSSES.items() if not loss.needs_truth)
            raise InputError(f"loss {name}: needs truth columns, found none; without: {free}")


def weighted(weights: Mapping[str, float], terms: Mapping[str, Tensor]) -> Tensor:
    """The weighted sum of terms."""
    total = sum((weights[name] * term for name, term in terms.items()), torch.zeros(()))
    return torch.as_tensor(total)


def total_loss(
    weights: Mapping[str, float], track: Track, log: Rows, context: LossContext
) -> tuple[Tensor, dict[str, Tensor]]:
    """Weighted sum of the named losses, and each term before weighting.

    Raises:
        InputError: an unknown name, or truth needed that the log does not have.
    """
    check_losses(weights, log)
    terms = {name: LOSSES[name](track, log, context) for name in weights}
    return weighted(weights, terms), terms
