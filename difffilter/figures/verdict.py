"""Figures of a verdict: consistency over time, and errors under other conditions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from matplotlib.figure import Figure
from torch import Tensor

from difffilter.figures.style import COLOURS, axes_grid
from difffilter.log import Log
from difffilter.metrics import nees, nees_states, scored_rows
from difffilter.run import Track
from difffilter.stress import CONDITIONS, Stressed

__all__ = ["consistency_figure", "stress_figure"]


def consistency_figure(log: Log, tracks: Mapping[str, Track]) -> Figure:
    """Mean NEES per state and mean NIS per channel over time, with their 95 % bands.

    The band of a mean of N chi-square variables with d degrees, divided by d, is
    1 +- 1.96 sqrt(2 / (N d)), for N d large.
    """
    figure, (left, right) = axes_grid(1, 2)
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
        ax.set_yscale("log")
        ax.set_xlabel("time (s)")
        ax.set_ylabel(name)
        ax.legend(frameon=False)
    return figure


def stress_figure(found: Sequence[Stressed]) -> Figure:
    """Position RMSE of published and tuned values against the level of each condition."""
    figure, axes = axes_grid(2, 2, 4.6, 3.2)
    for ax, (name, (meaning, _)) in zip(axes, CONDITIONS.items(), strict=True):
        here = [x for x in found if x.condition == name]
        levels = [x.level for x in here]
        for label, error in (
            ("published", [x.published for x in here]),
            ("tuned", [x.tuned for x in here]),
        ):
            ax.plot(levels, error, marker="o", label=label, color=COLOURS[label])
        errors = [error for x in here for error in (x.published, x.tuned)]
        if max(errors) > 20.0 * min(errors):
            ax.set_yscale("log")
        else:
            ax.set_ylim(bottom=0.0)
        ax.set_xlabel(meaning)
        ax.set_ylabel("position RMSE (m)")
    axes[0].legend(frameon=False)
    return figure


def _time(track: Track) -> Tensor:
    return track.time if track.time.dim() == 1 else track.time[:, 0]


def _mean(value: Tensor) -> Tensor:
    return value.flatten(1).nanmean(1)
