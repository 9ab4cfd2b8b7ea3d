"""The file of estimates that ``difffilter run`` writes, and its summary."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, BinaryIO

import torch
from torch import Tensor

from difffilter.files import write_atomically
from difffilter.logs.log import Log
from difffilter.logs.times import FORMATS, Clock
from difffilter.logs.track import Track
from difffilter.logs.writing import Columns, parts_for
from difffilter.scoring.metrics import REJECTED, Score, position_error, scored_rows

__all__ = ["Tally", "columns", "write_estimates"]


class Tally:
    """What is told of a run, window by window.

    Args:
        log: the whole log, with the channels of all systems; score: which rows count.
    """

    def __init__(self, log: Log, score: Score | str) -> None:
        self.log, self.score = log, score
        self.rows = self.scored = 0
        self.squared = 0.0
        self.low: dict[str, int] = {}
        self.present: dict[str, int] = {}
        self.isolated: dict[str, int] = {}

    def add(self, track: Track) -> None:
        """Count the next window: a trajectory in a batch of its own."""
        log = self.log.rows(self.rows, self.rows + len(track.mean))
        self.rows += log.steps
        positions = {name for name in track.states if not name.startswith("v")}
        if log.truth is not None and positions <= set(log.truth_states):
            rows = scored_rows(log, track, self.score)
            self.scored += int(rows.sum())
            self.squared += float(position_error(log, track)[rows].sum())
        for i, name in enumerate(track.channels):
            self.low.setdefault(name, 0)
            self.present.setdefault(name, 0)
            if track.record is not None:
                present = track.record.present[..., i]
                low = (track.record.weight[..., i] < REJECTED) & present
                self.low[name] += int(low.sum())
                self.present[name] += int(present.sum())
                left_out = int(track.record.isolated[..., i].sum())
                self.isolated[name] = self.isolated.get(name, 0) + left_out

    def summary(self) -> dict[str, Any]:
        """Number of rows, position RMSE (None without its truth), share rejected per channel."""
        error = math.sqrt(self.squared / self.scored) if self.scored else math.nan
        left_out = {n: count / self.rows for n, count in self.isolated.items() if count}
        return {
            "rows": self.rows,
            "rmse": error if math.isfinite(error) else None,
            "rejected": {n: count / max(self.present[n], 1) for n, count in self.low.items()},
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
    for i, state in enumerate(track.states):
        found[f"{state}_std"] = track.std[:, 0, i]
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
        for i, a in enumerate(track.states)
        for j, b in enumerate(track.states[:i])
    }


def _later(track: Track, covariance: bool) -> dict[str, Tensor]:
    """Columns of smoothed estimates."""
    found = {f"{name}_smoothed": track.mean[:, 0, i] for i, name in enumerate(track.states)}
    std = {f"{name}_smoothed_std": track.std[:, 0, i] for i, name in enumerate(track.states)}
    return found | std | (_covariances(track, "_smoothed") if covariance else {})


def _weights(log: Log, track: Track) -> Tensor:
    """Estimators without records use every measurement that there is."""
    if track.record is None:
        return log.present.to(log.z.dtype)
    return torch.where(track.record.present, track.record.weight, 0.0)
