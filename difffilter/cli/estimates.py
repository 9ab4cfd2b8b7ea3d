"""The file of estimates that ``difffilter run`` writes, and its summary."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from difffilter.files import write_atomically
from difffilter.logs.log import Log
from difffilter.logs.times import Clock
from difffilter.logs.track import Track
from difffilter.scoring.metrics import Score, isolated, rejected, rmse

__all__ = ["columns", "summary", "write_estimates"]


def write_estimates(path: str, log: Log, track: Track, clock: Clock) -> None:
    """Write the columns as CSV, times as the log has them; empty where there is no number."""
    table = columns(log, track)
    seconds = table.pop("time")
    lines = [",".join(("time", *table))]
    for time, *row in zip(clock.write(np.array(seconds)), *table.values(), strict=True):
        fields = (repr(value) if math.isfinite(value) else "" for value in row)
        lines.append(",".join((time, *fields)))
    write_atomically(path, "\n".join(lines) + "\n")


def columns(log: Log, track: Track) -> dict[str, list[float]]:
    """Time, mean, standard deviations, weight per channel (0 where missing), nominal NIS.

    Args:
        log: one trajectory, in a batch of its own; track: of that log.
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
    return {name: column.tolist() for name, column in found.items()}


def _weights(log: Log, track: Track) -> Tensor:
    """Estimators without records use every measurement that there is."""
    if track.record is None:
        return log.present.to(log.z.dtype)
    return torch.where(track.record.present, track.record.weight, 0.0)


def summary(log: Log, track: Track, score: Score | str) -> dict[str, Any]:
    """Number of rows, position RMSE (None without its truth), share rejected per channel."""
    positions = {name for name in track.states if not name.startswith("v")}
    known = log.truth is not None and positions <= set(log.truth_states)
    error = float(rmse(log, track, score)) if known else math.nan
    return {
        "rows": log.steps,
        "rmse": error if math.isfinite(error) else None,
        "rejected": dict.fromkeys(track.channels, 0.0) | rejected(track),
        **({"isolated": left_out} if (left_out := isolated(track)) else {}),
    }
