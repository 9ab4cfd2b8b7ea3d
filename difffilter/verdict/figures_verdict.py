"""The figure of a verdict: consistency over time."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from matplotlib.figure import Figure
from torch import Tensor

from difffilter.errors import InputError
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.reports.figures.style import COLOURS, axes_grid, plain_log
from difffilter.scoring.metrics import nees, nees_states, scored_rows

__all__ = ["autocorrelation", "consistency_figure"]

#: Consistency below this looks like this: a start that is known for sure.
LOWEST = 0.05


def consistency_figure(log: Log, tracks: Mapping[str, Track]) -> Figure:
    """Mean NEES per state and NIS per channel over time, and the innovations' autocorrelation.

    The band of a mean of N chi-square variables with d degrees, divided by d, is
    1 +- 1.96 sqrt(2 / (N d)), for N d large; that of a correlation +- 1.96 / sqrt(N).
    """
    figure, (left, right, last) = axes_grid(1, 3, width=4.4)
    for label, track in tracks.items():
        colour = COLOURS.get(label, COLOURS["other"])
        time = _time(track)
        states = nees_states(log, track)
        rows = scored_rows(log, track)
        value = torch.where(rows, nees(log, track), torch.nan)
        left.plot(time, _mean(value) / states, label=label, color=colour, linewidth=1.0)
        if track.record is not None:
            present = track.record.present.sum(-1).double()
            per_row = track.record.nis.flatten(1).sum(1) / present.flatten(1).sum(1)
            right.plot(time, per_row, label=label, color=colour, linewidth=1.0)
            found, band = autocorrelation(track)
            last.plot(range(1, len(found) + 1), found, ".-", label=label, color=colour)
            last.axhspan(-band, band, color=COLOURS["clairvoyant"], alpha=0.15, linewidth=0)
    first = next(iter(tracks.values()))
    count = log.trajectories
    channels = len(first.channels)
    for ax, degrees, name in (
        (left, nees_states(log, first), "NEES per state"),
        (right, channels, "NIS per channel"),
    ):
        half = 1.96 * math.sqrt(2.0 / (count * degrees))
        ax.axhspan(1.0 - half, 1.0 + half, color=COLOURS["clairvoyant"], alpha=0.25, linewidth=0)
        ax.axhline(1.0, color=COLOURS["truth"], linewidth=0.6)
        plain_log(ax, "y")
        ax.set_ylim(bottom=max(ax.get_ylim()[0], LOWEST))
        ax.set_xlabel("time (s)")
        ax.set_ylabel(name)
        ax.legend(frameon=False)
    last.axhline(0.0, color=COLOURS["truth"], linewidth=0.6)
    last.set(xlabel="lag (steps)", ylabel="autocorrelation of innovations")
    return figure


def autocorrelation(track: Track, lags: int = 20) -> tuple[list[float], float]:
    """Of the normalised innovations, per lag, and half the band of white ones (95 %).

    Innovations beyond 3 sigma count as 3 sigma: outliers are not what this asks about.

    Raises:
        InputError: a track without records.
    """
    record = track.record
    if record is None:
        raise InputError("autocorrelation: expected a filter with records")
    sigma = record.innovation_variance.sqrt()
    normal = torch.where(record.present, (record.innovation / sigma).clamp(-3.0, 3.0), torch.nan)
    found, count = [], 1
    for lag in range(1, min(lags, len(normal) - 1) + 1):
        first, second = normal[:-lag], normal[lag:]
        known = torch.isfinite(first) & torch.isfinite(second)
        a, b = first[known], second[known]
        count = max(len(a), 1)
        found.append(float((a * b).mean() / (a.square().mean() * b.square().mean()).sqrt()))
    return found, 1.96 / math.sqrt(count)


def _time(track: Track) -> Tensor:
    return track.time if track.time.dim() == 1 else track.time[:, 0]


def _mean(value: Tensor) -> Tensor:
    return value.flatten(1).nanmean(1)
