"""Estimate minus truth: which rows and which states count, and by how much they differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.errors import InputError, shown
from difffilter.logs.log import Rows
from difffilter.logs.states import AXES, KINDS, UNITS
from difffilter.logs.track import Track

__all__ = [
    "SCORES",
    "Score",
    "difference",
    "known_states",
    "position_difference",
    "position_error",
    "scored_difference",
    "scored_rows",
    "scored_states",
    "scored_unit",
    "squared_error",
]

SCORES = ("all", "measured")


@dataclass(frozen=True)
class Score:
    """Which rows of a log count, and the error of which states.

    Attributes:
        rows: ``all``, or those ``measured`` by at least one channel.
        first, last: s, times of the log between which rows count, both included.
        states: names of the states whose error is scored; none for the position (or, where a
            model has no position, for its velocities, else its angles, else all others).
    """

    rows: str = "all"
    first: float = -math.inf
    last: float = math.inf
    states: tuple[str, ...] = ()


def known_states(log: Rows, track: Track) -> list[str]:
    """Errors that the truth tells: those of states, and of the tangent space of others.

    A rotation's three numbers are known where the truth has all numbers of a quaternion.
    """
    plain = [name for name in track.states if name in log.truth_states]
    if track.local is None:
        return plain
    bent = [name for name in track.states if name not in track.errors]
    told = set(bent) <= set(log.truth_states)
    return [n for n in track.errors if n in plain or (told and n not in track.states)]


def scored_states(log: Rows, track: Track, score: Score | str = "all") -> list[str]:
    """The states whose error is scored.

    Raises:
        InputError: no truth of one of them.
    """
    names = list(score.states) if isinstance(score, Score) else []
    for name in names:
        if name not in (*track.states, *track.errors):
            expected = ", ".join(dict.fromkeys((*track.states, *track.errors)))
            raise InputError(f"state: found {shown(name)}, expected among {expected}")
    kinds = [track.kind(name) for name in track.errors]
    chosen = next((kind for kind in KINDS if kind in kinds), "position")
    names = names or [name for name in track.errors if track.kind(name) == chosen]
    if log.truth is None or not set(names) <= {*log.truth_states, *known_states(log, track)}:
        found = ", ".join(f"truth_{name}" for name in log.truth_states) or "none"
        expected = " and ".join(f"truth_{name}" for name in names or AXES)
        raise InputError(f"truth: found {found}, expected {expected}")
    return names


def scored_unit(log: Rows, track: Track, score: Score | str = "all") -> str:
    """Unit of the scored states' error; empty where they have several, or it is not known."""
    units = {UNITS[track.kind(name)] for name in scored_states(log, track, score)}
    return units.pop() if len(units) == 1 else ""


def difference(log: Rows, track: Track, names: Sequence[str]) -> Tensor:
    """(T, ..., len(names)), estimate minus truth, angles wrapped to [-pi, pi).

    0 where either is missing, so that no NaN enters a gradient.
    """
    assert log.truth is not None
    if track.local is not None and not set(names) <= set(track.states):
        return _tangent(log, track, names)
    truth = log.truth[..., [log.truth_states.index(name) for name in names]]
    mean = track.mean[..., track.named(names)]
    apart = mean - truth.nan_to_num()
    if any(track.kind(name) == "angle" for name in names):
        wrapped = torch.remainder(apart + torch.pi, 2.0 * torch.pi) - torch.pi
        columns = [
            (wrapped if track.kind(name) == "angle" else apart)[..., i]
            for i, name in enumerate(names)
        ]
        apart = torch.stack(columns, dim=-1)
    return torch.where(torch.isfinite(truth) & torch.isfinite(mean), apart, 0.0)


def _tangent(log: Rows, track: Track, names: Sequence[str]) -> Tensor:
    """The same in the tangent space at the estimate: minus the shift from it to the truth."""
    assert log.truth is not None
    assert track.local is not None
    given = dict(zip(log.truth_states, log.truth.unbind(-1), strict=True))
    mean = dict(zip(track.states, track.mean.unbind(-1), strict=True))
    # What the truth does not tell is left as estimated, and nobody asks for it.
    truth = torch.stack([given.get(name, mean[name]) for name in track.states], dim=-1)
    known = torch.isfinite(truth) & torch.isfinite(track.mean)
    known = known.all(-1, keepdim=True)
    filled = torch.where(known, truth, track.mean)
    apart = -track.local(track.mean, filled)[..., track.rows(names)]
    return torch.where(known, apart, 0.0)


def scored_difference(log: Rows, track: Track, score: Score | str = "all") -> Tensor:
    """(T, ..., q), estimated minus true scored states; 0 where either is missing."""
    return difference(log, track, scored_states(log, track, score))


def squared_error(log: Rows, track: Track, score: Score | str = "all") -> Tensor:
    """(T, ...), squared distance of the estimate to the truth in the scored states.

    0 where there is no truth or no estimate: sum over :func:`scored_rows` only.
    """
    return scored_difference(log, track, score).square().sum(-1)


def position_difference(log: Rows, track: Track) -> Tensor:
    """(T, ..., axes), estimated minus true position, m; 0 where either is missing."""
    names = [name for name in track.states if track.kind(name) == "position"]
    return scored_difference(log, track, Score(states=tuple(names)))


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
