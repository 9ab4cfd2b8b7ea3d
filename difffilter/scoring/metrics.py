"""Errors and consistency of estimates: folds over tracks, logs and records."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.logs.log import Rows
from difffilter.logs.track import Track
from difffilter.motions.blocks import AXES
from difffilter.seeds import stream

__all__ = [
    "REJECTED",
    "SCORES",
    "Score",
    "bootstrap_indices",
    "bootstrap_interval",
    "difference",
    "isolated",
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
]


SCORES = ("all", "measured")
#: Trajectories below which intervals come from blocks of rows.
FEW = 20
#: A measurement with a weight below it counts as rejected.
REJECTED = 0.1


@dataclass(frozen=True)
class Score:
    """Which rows of a log count.

    Attributes:
        rows: ``all``, or those ``measured`` by at least one channel.
        first, last: s, times of the log between which rows count, both included.
    """

    rows: str = "all"
    first: float = -math.inf
    last: float = math.inf


def _position_states(log: Rows, track: Track) -> list[str]:
    names = [name for name in track.states if name in AXES]
    missing = [name for name in names if name not in log.truth_states]
    if log.truth is None or not names or missing:
        found = ", ".join(f"truth_{name}" for name in log.truth_states) or "none"
        expected = " and ".join(f"truth_{name}" for name in names or AXES)
        raise InputError(f"truth: found {found}, expected {expected}")
    return names


def position_difference(log: Rows, track: Track) -> Tensor:
    """(T, ..., axes), estimated minus true position, m; 0 where either is missing."""
    return difference(log, track, _position_states(log, track))


def difference(log: Rows, track: Track, names: list[str]) -> Tensor:
    """Estimate minus truth; 0 where either is missing, so that no NaN enters a gradient."""
    assert log.truth is not None
    truth = log.truth[..., [log.truth_states.index(name) for name in names]]
    mean = track.mean[..., track.named(names)]
    return torch.where(torch.isfinite(truth) & torch.isfinite(mean), mean - truth.nan_to_num(), 0.0)


def position_error(log: Rows, track: Track) -> Tensor:
    """(T, ...), squared distance of the estimated to the true position, m^2.

    0 where there is no truth or no estimate: sum over :func:`scored_rows` only.
    """
    return position_difference(log, track).square().sum(-1)


def scored_rows(log: Rows, track: Track, score: Score | str = "all") -> Tensor:
    """(T, ...), rows that count: those with truth and an estimate, as ``score`` says.

    Args:
        score: a :class:`Score`, or its ``rows`` alone. Rows that only pad a shorter log have
            no truth and never count.
    """
    if log.truth is None:
        raise InputError(
            "truth: found none, expected truth_x (and truth_y, truth_z) columns; without truth, "
            "inspect and run tell NIS and residuals"
        )
    chosen = Score(score) if isinstance(score, str) else score
    rows = torch.isfinite(log.truth).all(-1) & torch.isfinite(track.mean).all(-1)
    time = log.time[(..., *[None] * (rows.dim() - log.time.dim()))]
    rows = rows & (time >= chosen.first) & (time <= chosen.last)
    return rows & log.measured if chosen.rows == "measured" else rows


def rmse(log: Rows, track: Track, score: Score | str = "all") -> Tensor:
    """Position root mean square error over scored rows of all trajectories: scalar, m.

    Args:
        log: with truth (T, ..., q); track: estimates of its rows.
        score: which rows count, as for :func:`scored_rows`.

    Raises:
        InputError: no truth.
    """
    rows = scored_rows(log, track, score)
    return position_error(log, track)[rows].mean().sqrt()


def nees(log: Rows, track: Track, per_position: bool = False) -> Tensor:
    """(T, ...), normalised estimation error squared e^T P^-1 e over the true states.

    Divide by the number of those states for the NEES per state, expected 1.

    Args:
        per_position: position states alone.

    NaN where the covariance of these states is singular: the error has no such square there.

    Raises:
        InputError: no truth.
    """
    names = (
        _position_states(log, track)
        if per_position
        else [name for name in log.truth_states if name in track.states]
    )
    error = difference(log, track, names)
    deviations = track.deviations[..., track.named(names), :]
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
    if per_position:
        return len(_position_states(log, track))
    return len([name for name in log.truth_states if name in track.states])


def nis_per_channel(track: Track) -> Tensor:
    """Mean nominal NIS per present channel over all rows, expected 1; NaN without records."""
    if track.record is None:
        return torch.tensor(float("nan"))
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
    total, count = _per_trajectory(squared, rows)
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
    total, _ = _per_trajectory(squared, rows)
    base, _ = _per_trajectory(reference, rows)
    at = bootstrap_indices(total.shape[0], draws, seed)
    values = (total[at].sum(1) / base[at].sum(1)).sqrt()
    return (float((total.sum() / base.sum()).sqrt()), *_quantiles(values))


def _per_trajectory(squared: Tensor, rows: Tensor) -> tuple[Tensor, Tensor]:
    squared = torch.where(rows, squared, 0.0)
    total, count = squared.reshape(len(squared), -1), rows.reshape(len(rows), -1)
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
