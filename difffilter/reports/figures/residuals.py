"""Errors of measurements over time, and how they go on."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from difffilter.reports.figures.style import axes_grid

__all__ = ["residual_figure"]

Array = NDArray[np.float64]
#: Channels that are drawn, the first ones.
MOST = 12


def residual_figure(time: Array, errors: Array, channels: tuple[str, ...], unit: str) -> Figure:
    """Each channel's errors over time, and their autocorrelation by lag.

    Args:
        time: (T,), s; errors: (T, m), NaN where there is none; unit: of the errors.
    """
    figure, (left, right) = axes_grid(1, 2)
    for i, name in enumerate(channels[:MOST]):
        left.plot(time, errors[:, i], lw=0.7, label=name)
        lags, values = autocorrelation(time, errors[:, i])
        right.plot(lags, values, lw=1.0, label=name)
    left.set(xlabel="time (s)", ylabel=f"measured minus true ({unit})", title="errors")
    right.set(xlabel="lag (s)", ylabel="autocorrelation", title="errors over time", ylim=(-0.5, 1))
    right.axhline(0.0, color="black", lw=0.5)
    left.legend(fontsize="small")
    return figure


def autocorrelation(time: Array, errors: Array, lags: int = 100) -> tuple[Array, Array]:
    """Lags (s, of the usual interval) and the correlation of errors that far apart in rows."""
    values = errors - np.nanmedian(errors) if np.isfinite(errors).any() else errors
    count = min(lags, len(values) // 4)
    found = np.full(count + 1, np.nan)
    for k in range(count + 1):
        a, b = values[: len(values) - k], values[k:]
        both = ~np.isnan(a) & ~np.isnan(b)
        scale = np.sqrt((a[both] ** 2).sum() * (b[both] ** 2).sum())
        found[k] = (a[both] * b[both]).sum() / scale if scale > 0.0 else np.nan
    usual = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    return np.asarray(np.arange(count + 1) * usual, dtype=np.float64), found
