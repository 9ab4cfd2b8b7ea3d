"""Probabilities of a mixture's modes over time."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from difffilter.errors import InputError
from difffilter.logs.track import Track
from difffilter.reports.figures.style import axes_grid

__all__ = ["draw_modes", "modes_figure"]

_COLOURS = ("#0072B2", "#E69F00", "#009E73", "#CC79A7", "#56B4E9", "#D55E00", "#F0E442", "#999999")


def modes_figure(track: Track, trajectory: int | None = None, title: str = "") -> Figure:
    """Probability of each mode, stacked, over time.

    Args:
        track: of a mixture, (T, B, ...) or (T, ...).
        trajectory: which one of a batch; the mean over all if None.

    Raises:
        InputError: a track of no mixture.
    """
    figure, axes = axes_grid(1, 1, width=8.0)
    if title:
        figure.suptitle(title)
    draw_modes(axes[0], track, trajectory)
    return figure


def draw_modes(ax: Axes, track: Track, trajectory: int | None = None) -> None:
    """The same, onto given axes."""
    if track.record is None or not track.modes:
        raise InputError("modes: found a track of no mixture, expected one with mode probabilities")
    shares = track.record.modes.detach().numpy()
    time = track.time.detach().numpy()
    shares = shares.reshape(len(shares), -1, shares.shape[-1])
    time = np.broadcast_to(time.reshape(len(time), -1), shares.shape[:2])
    shown = shares.mean(1) if trajectory is None else shares[:, trajectory % shares.shape[1]]
    seconds = time[:, 0 if trajectory is None else trajectory % time.shape[1]]
    for k, mode in enumerate(track.modes):
        below = shown[:, :k].sum(-1)
        colour = _COLOURS[k % len(_COLOURS)]
        ax.fill_between(
            seconds, below, below + shown[:, k], color=colour, lw=0, alpha=0.85, label=mode
        )
    ax.set(
        xlabel="time (s)", ylabel="probability", title="modes", ylim=(0.0, 1.0),
        xlim=(seconds[0], seconds[-1]) if len(seconds) > 1 else None,
    )  # fmt: skip
    ax.legend(fontsize=8, loc="upper left", framealpha=0.6)
