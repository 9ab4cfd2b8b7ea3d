"""A quantity over two parameters, with marked points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from difffilter.reports.figures.style import COLOURS, axes_grid

__all__ = ["surface_figure"]


def surface_figure(
    panels: Mapping[str, Sequence[Sequence[float]]],
    x: Sequence[float],
    y: Sequence[float],
    xlabel: str,
    ylabel: str,
    unit: str,
    *,
    points: Mapping[str, tuple[float, float]] | None = None,
    own: Mapping[str, Mapping[str, tuple[float, float]]] | None = None,
    log: tuple[bool, bool] = (True, True),
    columns: int = 2,
    diverging: bool = False,
) -> Figure:
    """One panel per entry: filled contours of values (len(y), len(x)).

    Args:
        panels: title to values.
        points: label to (x, y); labels with "published", "tuned" or "ideal" in them get the
            colours that these have in every figure; own: further ones of single panels.
        log: whether each axis is logarithmic.
        diverging: colours about 0 instead of a logarithmic scale.
    """
    rows = -(-len(panels) // columns)
    figure, axes = axes_grid(rows, min(columns, len(panels)), width=5.0, height=4.0)
    for ax, (title, values) in zip(axes, panels.items(), strict=False):
        table = np.asarray(values)
        if diverging:
            levels = np.linspace(-1.0, 1.0, 21)
            drawn = ax.contourf(x, y, table, levels=levels, cmap="RdBu_r", extend="both")
        else:
            levels = np.geomspace(table.min(), table.max() * (1 + 1e-9), 16)
            drawn = ax.contourf(x, y, table, levels=levels, cmap="viridis", norm=LogNorm())
            ax.contour(x, y, table, levels=levels, colors="white", linewidths=0.3)
        ax.set(title=title, xlabel=xlabel, ylabel=ylabel)
        for name, logarithmic in zip("xy", log, strict=True):
            if logarithmic:
                ax.set(**{f"{name}scale": "log"})
        bar = figure.colorbar(drawn, ax=ax, label=unit)
        if not diverging:
            bar.ax.yaxis.set_major_formatter("{x:.3g}")
            bar.ax.yaxis.set_minor_formatter("")
        marked = {**(points or {}), **(own or {}).get(title, {})}
        for label, (px, py) in marked.items():
            keys = [key for key in ("tuned", "published") if key in label]
            colour = COLOURS[keys[0]] if keys else COLOURS["clairvoyant"]
            ax.plot(px, py, "o", ms=8, mfc=colour, mec="white", label=label)
        if marked:
            ax.legend(fontsize=7, loc="best")
    return figure
