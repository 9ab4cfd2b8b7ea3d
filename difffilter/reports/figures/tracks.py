"""One trajectory: track, errors with 3-sigma bands, rejected measurements."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from difffilter.logs.log import Log
from difffilter.logs.states import UNITS
from difffilter.logs.track import Track
from difffilter.reports.figures.modes import draw_modes
from difffilter.reports.figures.style import COLOURS, axes_grid
from difffilter.scoring.differences import difference, known_states

__all__ = ["track_figure"]


def track_figure(
    log: Log,
    track: Track,
    trajectory: int = 0,
    title: str = "",
    *,
    smoothed: Track | None = None,
) -> Figure:
    """Track, position errors with 3-sigma bands, weights, a mixture's modes over time.

    Args:
        log: (T, B, m) or (T, m), with truth or not (errors need it).
        track: of that log.
        trajectory: which one of a batch.
        smoothed: of the same log, drawn beside the filtered track, with bands of its own.
    """
    time, mean, std, weights, truth = _pick(log, track, trajectory)
    several = track.record is not None and bool(track.modes)
    figure, axes = axes_grid(3 if several else 2, 2)
    if title:
        figure.suptitle(title)
    later = None if smoothed is None else _pick(log, smoothed, trajectory)
    _draw_track(axes[0], log, track, mean, truth)
    if later is not None:
        _draw_later(axes[0], track, later[1])
    for i, name in enumerate(track.errors[:2]):
        error = _error(log, track, name, trajectory)
        _draw_error(axes[1 + i], _labelled(track, name), time, error, std[:, i])
        if smoothed is not None and later is not None:
            error = _error(log, smoothed, name, trajectory)
            _draw_later_error(axes[1 + i], time, error, later[2][:, i])
    _draw_weights(axes[3], track, time, weights)
    if several:
        draw_modes(axes[4], track, trajectory)
        axes[5].remove()
    return figure


def _pick(
    log: Log, track: Track, b: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None]:
    def one(x: object, trailing: int) -> np.ndarray:
        array = np.asarray(x.detach() if hasattr(x, "detach") else x)
        return array[:, b] if array.ndim > trailing + 1 else array

    weights = None
    if track.record is not None:
        seen = track.record.present.numpy()
        weights = one(np.where(seen, track.record.weight.detach().numpy(), np.nan), 1)
    truth = None if log.truth is None else one(log.truth, 1)
    return one(log.time, 0), one(track.mean, 1), one(track.std, 1), weights, truth


def _error(log: Log, track: Track, name: str, b: int) -> np.ndarray | None:
    """Estimate minus truth of one state (or number of the tangent space); NaN where unknown."""
    if log.truth is None or name not in known_states(log, track):
        return None
    apart = difference(log, track, [name])[..., 0]
    if name in log.truth_states:
        truth = log.truth[..., log.truth_states.index(name)]
        apart = torch.where(torch.isfinite(truth), apart, torch.nan)
    array = np.asarray(apart.detach())
    return array[:, b] if array.ndim > 1 else array


def _labelled(track: Track, name: str) -> str:
    """A state with its unit, where its kind tells it."""
    unit = UNITS[track.kind(name)]
    return f"{name} ({unit})" if unit else name


def _is_plane(track: Track) -> bool:
    """Whether the first two states are a position."""
    return len(track.states) > 1 and all(track.kind(n) == "position" for n in track.states[:2])


def _draw_track(
    ax: Axes, log: Log, track: Track, mean: np.ndarray, truth: np.ndarray | None
) -> None:
    if not _is_plane(track):
        ax.plot(mean[:, 0], color=COLOURS["tuned"], label="estimate")
        ax.set(xlabel="row", ylabel=_labelled(track, track.states[0]), title="track")
        return
    names = track.states[:2]
    if truth is not None and set(names) <= set(log.truth_states):
        x, y = (truth[:, log.truth_states.index(name)] for name in names)
        ax.plot(x, y, color=COLOURS["truth"], lw=1.0, label="truth")
    ax.plot(mean[:, 0], mean[:, 1], color=COLOURS["tuned"], lw=1.0, label="estimate")
    ax.plot(mean[0, 0], mean[0, 1], "o", color=COLOURS["published"], ms=5, label="start")
    ax.set(xlabel="x (m)", ylabel="y (m)", title="track")
    ax.set_aspect("equal", adjustable="datalim")
    ax.locator_params(axis="x", nbins=6)  # labels of many digits stay apart
    ax.legend(fontsize=8, loc="upper left", framealpha=0.6)


def _draw_error(
    ax: Axes,
    name: str,
    time: np.ndarray,
    error: np.ndarray | None,
    std: np.ndarray,
) -> None:
    ax.fill_between(time, -3 * std, 3 * std, color=COLOURS["tuned"], alpha=0.18, lw=0)
    ax.plot([], [], color=COLOURS["tuned"], alpha=0.3, lw=6, label="3 sigma")
    if error is not None:
        ax.plot(time, error, color=COLOURS["tuned"], lw=0.8, label="error")
        span = np.nanmax(np.abs(error)) if np.isfinite(error).any() else 1.0
        limit = max(1.3 * span, 1.3 * 3 * float(np.nanmedian(std)))
        ax.set_ylim(-limit, limit)
    ax.set(
        xlabel="time (s)", ylabel=f"error in {name}", title=f"{name.split()[0]}: estimate - truth"
    )
    ax.legend(fontsize=8, loc="upper left", framealpha=0.6)


def _draw_later(ax: Axes, track: Track, mean: np.ndarray) -> None:
    """The smoothed track over the filtered one."""
    flat = not _is_plane(track)
    line = (mean[:, 0],) if flat else (mean[:, 0], mean[:, 1])
    ax.plot(*line, color=COLOURS["clairvoyant"], lw=1.2, label="smoothed")
    ax.legend(fontsize=8, loc="upper left", framealpha=0.6)


def _draw_later_error(
    ax: Axes, time: np.ndarray, error: np.ndarray | None, std: np.ndarray
) -> None:
    """The smoothed error with its band, inside the filter's."""
    colour = COLOURS["clairvoyant"]
    ax.fill_between(time, -3 * std, 3 * std, color=colour, alpha=0.25, lw=0)
    if error is not None:
        ax.plot(time, error, color=colour, lw=0.8, label="smoothed error")
    ax.plot([], [], color=colour, alpha=0.4, lw=6, label="3 sigma, smoothed")
    ax.legend(fontsize=8, loc="upper left", framealpha=0.6)


def _draw_weights(ax: Axes, track: Track, time: np.ndarray, weights: np.ndarray | None) -> None:
    ax.set(xlabel="time (s)", title="weights: dark = rejected, grey = missing")
    ax.grid(False)
    if weights is None:
        ax.text(0.5, 0.5, "no weights", ha="center", transform=ax.transAxes)
        return
    ax.set_facecolor("#b8b8b8")
    image = ax.pcolormesh(
        time, np.arange(weights.shape[1]), weights.T, cmap="Blues_r", vmin=0.0, vmax=1.0,
        shading="nearest", rasterized=True,
    )  # fmt: skip
    ax.set_yticks(np.arange(weights.shape[1]), track.channels, fontsize=8)
    ax.figure.colorbar(image, ax=ax, label="weight")
