"""The file of estimates that ``difffilter run`` writes, and its summary."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, BinaryIO

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.files import write_atomically
from difffilter.logs.log import Log
from difffilter.logs.states import UNITS
from difffilter.logs.times import FORMATS, Clock
from difffilter.logs.track import Track
from difffilter.logs.writing import Columns, parts_for
from difffilter.scoring.differences import (
    Score,
    difference,
    known_states,
    scored_rows,
    scored_states,
    scored_unit,
    squared_error,
)
from difffilter.scoring.metrics import REJECTED

__all__ = ["Tally", "columns", "write_estimates"]

#: Measurements of a channel rejected one after the other from which on that is told.
LONG = 20


class Tally:
    """What is told of a run, window by window.

    Args:
        log: the whole log, with the channels of all systems; score: which rows count.
    """

    def __init__(self, log: Log, score: Score | str) -> None:
        self.log, self.score = log, score
        self.rows = self.scored = 0
        self.squared = 0.0
        self.by_state: dict[str, float] = {}
        self.units: dict[str, str] = {}
        self.states: list[str] = []
        self.what, self.unit = "position", "m"
        self.low: dict[str, int] = {}
        self.present: dict[str, int] = {}
        self.isolated: dict[str, int] = {}
        self.streak: dict[str, int] = {}  # rejected just now, and the most in a row
        self.longest: dict[str, int] = {}

    def add(self, track: Track) -> None:
        """Count the next window: a trajectory in a batch of its own."""
        log = self.log.rows(self.rows, self.rows + len(track.mean))
        self.rows += log.steps
        known = known_states(log, track)
        if log.truth is not None and known:
            rows = scored_rows(log, track, self.score)
            self.scored += int(rows.sum())
            apart = difference(log, track, known)[rows].square().sum(0).tolist()
            for name, squared in zip(known, apart, strict=True):
                self.by_state[name] = self.by_state.get(name, 0.0) + squared
                self.units[name] = UNITS[track.kind(name)]
            self._score(log, track, rows)
        for i, name in enumerate(track.channels):
            self.low.setdefault(name, 0)
            self.present.setdefault(name, 0)
            if track.record is not None:
                present = track.record.present[..., i]
                low = (track.record.weight[..., i] < REJECTED) & present
                self.low[name] += int(low.sum())
                self.present[name] += int(present.sum())
                self._count_streak(name, low[present].tolist())
                left_out = int(track.record.isolated[..., i].sum())
                self.isolated[name] = self.isolated.get(name, 0) + left_out

    def _score(self, log: Log, track: Track, rows: Tensor) -> None:
        """Add the squared error of the scored states, if their truth is known."""
        try:
            self.states = scored_states(log, track, self.score)
        except InputError:
            if isinstance(self.score, Score) and self.score.states:
                raise  # asked for by name
            return
        self.squared += float(squared_error(log, track, self.score)[rows].sum())
        if any(track.kind(name) != "position" for name in self.states):
            self.what = ", ".join(self.states)
            self.unit = scored_unit(log, track, self.score)

    def _count_streak(self, name: str, low: list[bool]) -> None:
        """Measurements of a channel that were rejected one after the other."""
        streak, longest = self.streak.get(name, 0), self.longest.get(name, 0)
        for rejected in low:
            streak = streak + 1 if rejected else 0
            longest = max(longest, streak)
        self.streak[name], self.longest[name] = streak, longest

    def warnings(self) -> list[str]:
        """A line for each channel that was rejected for long."""
        return [
            f"{name} was rejected {count} times in a row: wrong units, a broken sensor, or a "
            "filter that is lost (recovery takes it back)"
            for name, count in self.longest.items()
            if count >= LONG
        ]

    def summary(self) -> dict[str, Any]:
        """Number of rows, RMSE (None without its truth), by state too, and what was rejected."""
        counted = self.scored if self.states else 0
        error = math.sqrt(self.squared / counted) if counted else math.nan
        by_state = {n: math.sqrt(s / self.scored) for n, s in self.by_state.items() if self.scored}
        left_out = {n: count / self.rows for n, count in self.isolated.items() if count}
        return {
            "rows": self.rows,
            "rmse": error if math.isfinite(error) else None,
            "rejected": {n: count / max(self.present[n], 1) for n, count in self.low.items()},
            **({"states": by_state} if by_state else {}),
            **({"isolated": left_out} if left_out else {}),
        }


def write_estimates(
    path: str,
    windows: Iterable[tuple[Log, Track]],
    clock: Clock,
    tally: Tally,
    covariance: bool = False,
    smoothed: Track | None = None,
) -> None:
    """Write the columns, times as the log has them; empty where there is no number.

    Args:
        path: ``.parquet`` for Parquet (needs pyarrow), else CSV.
        windows: parts of a log and their estimates, in order: never all of them in memory.
        tally: counts them.
        covariance: whether to write covariances as well.
        smoothed: of the only window, in columns of its own.
    """

    def content(file: BinaryIO) -> None:
        writer = parts_for(path, file)
        for log, track in windows:
            tally.add(track)
            table = columns(log, track, covariance)
            if smoothed is not None:
                table |= _later(smoothed, covariance)
            writer.write(_dated(table, clock))
        writer.close()

    write_atomically(path, content)


def _dated(table: dict[str, Tensor], clock: Clock) -> Columns:
    seconds = table["time"].numpy()
    if FORMATS[clock.format] == (1.0, False):
        return {name: column.numpy() for name, column in table.items()}
    rest = {name: column.numpy() for name, column in table.items() if name != "time"}
    return {"time": clock.write(seconds), **rest}


def columns(log: Log, track: Track, covariance: bool = False) -> dict[str, Tensor]:
    """Time, mean, deviations, weight per channel (0 where missing), NIS, mode probabilities.

    Args:
        log: one trajectory, in a batch of its own; track: of that log.
        covariance: also ``cov_A_B`` of every two different states, SI units.
    """
    time = log.time[:, 0] if log.time.dim() > 1 else log.time
    found: dict[str, Tensor] = {"time": time}
    for i, state in enumerate(track.states):
        found[state] = track.mean[:, 0, i]
    for i, error in enumerate(track.errors):
        found[f"{error}_std"] = track.std[:, 0, i]
    weight = _weights(log, track)
    for i, channel in enumerate(track.channels):
        found[f"{channel}_weight"] = weight[:, 0, i]
    none = torch.full_like(time, math.nan)
    found["nis"] = none if track.record is None else track.record.nis[:, 0]
    if track.record is not None:
        for k, mode in enumerate(track.modes):
            found[f"{mode}_probability"] = track.record.modes[:, 0, k]
    return found | (_covariances(track) if covariance else {})


def _covariances(track: Track, suffix: str = "") -> dict[str, Tensor]:
    full = track.covariance
    return {
        f"cov_{b}_{a}{suffix}": full[:, 0, i, j]
        for i, a in enumerate(track.errors)
        for j, b in enumerate(track.errors[:i])
    }


def _later(track: Track, covariance: bool) -> dict[str, Tensor]:
    """Columns of smoothed estimates."""
    found = {f"{name}_smoothed": track.mean[:, 0, i] for i, name in enumerate(track.states)}
    std = {f"{name}_smoothed_std": track.std[:, 0, i] for i, name in enumerate(track.errors)}
    return found | std | (_covariances(track, "_smoothed") if covariance else {})


def _weights(log: Log, track: Track) -> Tensor:
    """Estimators without records use every measurement that there is."""
    if track.record is None:
        return log.present.to(log.z.dtype)
    return torch.where(track.record.present, track.record.weight, 0.0)
