"""Errors and consistency of estimates: folds over tracks, logs and records."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from difffilter.logs.log import Rows
from difffilter.logs.track import Track
from difffilter.scoring.differences import (
    SCORES,
    Score,
    difference,
    known_states,
    position_difference,
    position_error,
    scored_rows,
    scored_states,
    squared_error,
)
from difffilter.seeds import stream

__all__ = [
    "REJECTED",
    "SCORES",
    "Score",
    "bootstrap_indices",
    "bootstrap_interval",
    "difference",
    "in_blocks",
    "isolated",
    "mean_interval",
    "mean_nees",
    "nees",
    "nees_states",
    "nis_per_channel",
    "paired_ratio",
    "position_difference",
    "position_error",
    "rejected",
    "rmse",
    "scored_rows",
    "squared_error",
    "state_rmse",
]


#: Trajectories below which intervals come from blocks of rows.
FEW = 20
#: A measurement with a weight below it counts as rejected.
REJECTED = 0.1


def rmse(log: Rows, track: Track, score: Score | str = "all") -> Tensor:
    """Root mean square error of the scored states, of all trajectories: scalar; m of a position.

    Args:
        log: with truth (T, ..., q); track: estimates of its rows.
        score: which rows count, and which states (the position), see :class:`Score`.

    Raises:
        InputError: no truth.
    """
    rows = scored_rows(log, track, score)
    return squared_error(log, track, score)[rows].mean().sqrt()


def state_rmse(log: Rows, track: Track, rows: Tensor) -> dict[str, float]:
    """RMSE of each true state that is estimated, in its own unit, over ``rows`` (T, ...)."""
    names = known_states(log, track)
    apart = difference(log, track, names)[rows]
    return dict(zip(names, apart.square().mean(0).sqrt().tolist(), strict=True))


def nees(log: Rows, track: Track, per_position: bool = False) -> Tensor:
    """(T, ...), normalised estimation error squared e^T P^-1 e over the true states.

    Divide by the number of those states for the NEES per state, expected 1.

    Args:
        per_position: position states alone.

    NaN where the covariance of these states is singular: the error has no such square there.

    Raises:
        InputError: no truth.
    """
    names = _nees_names(log, track, per_position)
    error = difference(log, track, names)
    deviations = track.deviations[..., track.rows(names), :]
    covariance = deviations @ deviations.mT
    # Where there is no estimate (NaN rows, never scored) any regular matrix will do.
    known = torch.isfinite(covariance).all(-1).all(-1)[..., None, None]
    identity = torch.eye(len(names), dtype=covariance.dtype)
    covariance = torch.where(known, covariance, identity)
    singular = torch.linalg.cholesky_ex(covariance.detach()).info != 0
    regular = torch.where(singular[..., None, None], identity, covariance)
    white = torch.linalg.solve_triangular(
        torch.linalg.cholesky(regular), error.unsqueeze(-1), upper=False
    )
    return torch.where(singular, torch.nan, white.squeeze(-1).square().sum(-1))


def mean_nees(log: Rows, track: Track, rows: Tensor) -> Tensor:
    """Mean NEES per state over ``rows`` (T, ...) with a regular covariance; 1 expected."""
    squared = nees(log, track)
    rows = rows & ~torch.isnan(squared)
    total = torch.where(rows, squared, 0.0).sum()
    return total / rows.sum() / nees_states(log, track)


def nees_states(log: Rows, track: Track, per_position: bool = False) -> int:
    """Number of states that :func:`nees` covers."""
    return len(_nees_names(log, track, per_position))


def _nees_names(log: Rows, track: Track, per_position: bool) -> list[str]:
    if per_position:
        return [name for name in scored_states(log, track) if track.kind(name) == "position"]
    names = [name for name in known_states(log, track) if name in track.errors]
    if track.local is not None:
        return names
    return sorted(names, key=log.truth_states.index)


def nis_per_channel(track: Track) -> Tensor:
    """Mean nominal NIS per present channel over all rows, expected 1; NaN without records."""
    if track.record is None:
        return torch.tensor(math.nan, dtype=torch.float64)
    count = track.record.present.sum()
    return track.record.nis.sum() / count.clamp_min(1)


def rejected(track: Track, below: float = REJECTED) -> dict[str, float]:
    """Share, 0 to 1, of each channel's present measurements with a weight below ``below``.

    By channel name, over all rows and trajectories.
    """
    if track.record is None:
        return {}
    present = track.record.present.flatten(0, -2)
    low = (track.record.weight.flatten(0, -2) < below) & present
    share = low.sum(0).double() / present.sum(0).clamp_min(1)
    return dict(zip(track.channels, share.tolist(), strict=True))


def isolated(track: Track) -> dict[str, float]:
    """Share of rows in which a channel's sensor was left out as not finite, where any was."""
    if track.record is None:
        return {}
    share = track.record.isolated.flatten(0, -2).double().mean(0)
    named = dict(zip(track.channels, share.tolist(), strict=True))
    return {channel: value for channel, value in named.items() if value > 0.0}


def bootstrap_indices(count: int, draws: int, seed: int) -> Tensor:
    """(draws, count) indices of trajectories, with replacement."""
    return torch.randint(count, (draws, count), generator=stream(seed, "bootstrap"))


def bootstrap_interval(
    squared: Tensor, rows: Tensor, draws: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """95 % interval of the RMSE from resampled trajectories.

    Fewer than ``FEW`` trajectories are cut into equal blocks of rows, at least that many in
    all, and the blocks resampled: one run would else have no interval at all.

    Args:
        squared: (T, B) squared errors; rows: (T, B) which count.
    """
    total, count = in_blocks(torch.where(rows, squared, 0.0), rows)
    at = bootstrap_indices(total.shape[0], draws, seed)
    values = (total[at].sum(1) / count[at].sum(1)).sqrt()
    return _quantiles(values)


def paired_ratio(
    squared: Tensor,
    reference: Tensor,
    rows: Tensor,
    draws: int = 2000,
    seed: int = 0,
) -> tuple[float, float, float]:
    """RMSE divided by a reference's RMSE on the same rows: value and 95 % interval.

    The same resampled trajectories (or blocks of few) serve both, so that what they share
    cancels.
    """
    total, _ = in_blocks(torch.where(rows, squared, 0.0), rows)
    base, _ = in_blocks(torch.where(rows, reference, 0.0), rows)
    at = bootstrap_indices(total.shape[0], draws, seed)
    values = (total[at].sum(1) / base[at].sum(1)).sqrt()
    return (float((total.sum() / base.sum()).sqrt()), *_quantiles(values))


def mean_interval(
    total: Tensor, count: Tensor, draws: int = 2000, seed: int = 0
) -> tuple[float, float, float]:
    """The mean of sums (T, B) over counts (T, B), with its 95 % interval from trajectories.

    Of fewer than ``FEW`` trajectories from blocks of rows. NaN where nothing counts.
    """
    sums, counts = in_blocks(total, count)
    if not len(sums):
        return (float("nan"),) * 3
    at = bootstrap_indices(sums.shape[0], draws, seed)
    values = sums[at].sum(1) / counts[at].sum(1)
    return (float(sums.sum() / counts.sum()), *_quantiles(values))


def in_blocks(total: Tensor, count: Tensor) -> tuple[Tensor, Tensor]:
    """Sums and counts (T, B) added up over each trajectory; of few, over blocks that count."""
    total, count = total.reshape(len(total), -1), count.reshape(len(count), -1)
    if total.shape[1] < FEW:
        blocks = -(-FEW // total.shape[1])
        length = -(-len(total) // blocks)
        total, count = (
            torch.stack([part.sum(0) for part in torch.split(x, length)]) for x in (total, count)
        )
        scored = count > 0
        return total[scored], count[scored]
    return total.sum(0), count.sum(0)


def _quantiles(values: Tensor) -> tuple[float, float]:
    low, high = torch.quantile(values, torch.tensor([0.025, 0.975], dtype=values.dtype)).tolist()
    return low, high
