"""Curves of several systems over one quantity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from difffilter.reports.figures.style import COLOURS, axes_grid

__all__ = ["curves_figure"]

_MARKERS = "osD^vP*Xh<>d"


def curves_figure(
    panels: Mapping[str, tuple[Sequence[float], Mapping[str, Sequence[float]]]],
    xlabel: str,
    ylabel: str,
    *,
    log: bool = False,
    emphasised: Sequence[str] = (),
    markers: bool = True,
    zero: bool = True,
) -> Figure:
    """One panel per entry: x values, and a curve per label.

    Args:
        panels: title to (x, label to y).
        log: logarithmic y axis.
        emphasised: labels drawn thick; labels with "tuned", "clairvoyant" or "published" in
            them get the colours that these have in every figure, others greys and hues.
        markers: at every point; zero: whether a linear y axis begins at 0.
    """
    figure, axes = axes_grid(1, len(panels), width=5.6, height=4.2)
    for ax, (title, (x, curves)) in zip(axes, panels.items(), strict=True):
        spare = iter(_spare_colours())
        for i, (label, y) in enumerate(curves.items()):
            marker = _MARKERS[i % len(_MARKERS)] if markers else ""
            style: dict[str, Any] = {"marker": marker, "ms": 4, "lw": 1.1}
            if label in emphasised:
                style |= {"lw": 2.4, "ms": 5.5}
            ax.plot(x, y, label=label, color=_colour(label, emphasised) or next(spare), **style)
        ax.set(title=title, xlabel=xlabel, ylabel=ylabel)
        if log:
            ax.set_yscale("log")
            ax.yaxis.set_major_formatter("{x:g}")
            low, high = ax.get_ylim()
            # Over less than two decades the major ticks alone would be too few.
            if high < 100.0 * low:
                ax.yaxis.set_minor_formatter("{x:g}")
                ax.tick_params(axis="y", which="minor", labelsize=7)
        elif zero:
            ax.set_ylim(bottom=0.0)
        ax.legend(fontsize=7)
    return figure


def _colour(label: str, emphasised: Sequence[str]) -> str | None:
    if "tuned" in label:
        return COLOURS["tuned"]
    if "clairvoyant" in label:
        return COLOURS["clairvoyant"]
    return COLOURS["published"] if label in emphasised else None


def _spare_colours() -> list[str]:
    return [
        "#999999", "#CC79A7", "#E69F00", "#56B4E9", "#8B6914", "#6A51A3", "#444444", "#B0B000",
        "#F0A0A0", "#70A070", "#A0A0F0", "#C0C0C0",
    ]  # fmt: skip
