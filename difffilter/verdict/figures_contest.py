"""Figures of a contest: the way of each method, and where the gain comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from statistics import median

from matplotlib.figure import Figure

from difffilter.reports.figures.style import COLOURS, axes_grid, plain_log
from difffilter.tuning.search import SEARCHES
from difffilter.verdict.contests import Contender, Course

__all__ = ["contest_figure", "gain_figure"]

#: Of the searches; whatever uses the gradient has the colour of tuned values.
SEARCH_COLOURS: Mapping[str, str] = {
    "random": COLOURS["other"], "nelder-mead": "#E69F00", "cma-es": "#CC79A7",
}  # fmt: skip


def contest_figure(courses: Sequence[Course]) -> Figure:
    """Held-out loss against filter runs and against seconds: thin lines, one per seed."""
    figure, axes = axes_grid(1, 2)
    for ax, name in zip(axes, ("runs", "seconds"), strict=True):
        seen = set()
        for course in courses:
            method = course.method
            colour = SEARCH_COLOURS.get(method, COLOURS["tuned"])
            x = [float(v) for v in getattr(course, name)]
            label = method if method in SEARCHES else f"gradient ({method})"
            ax.step(
                x[1:], course.loss[1:], where="post", color=colour, linewidth=1.3,
                label="" if method in seen else label, marker="o", markersize=2.5,
            )  # fmt: skip
            seen.add(method)
        published = median(course.loss[0] for course in courses)
        ax.axhline(published, color=COLOURS["published"], linestyle="--", label="published")
        plain_log(ax, "x")
        ax.set_xlabel({"runs": "filter runs", "seconds": "seconds"}[name])
        ax.set_ylabel("held-out loss")
    axes[0].legend(frameon=False, fontsize=8)
    return figure


def gain_figure(found: Sequence[Contender]) -> Figure:
    """Held-out RMSE of each way to choose values, by that of the published ones."""
    figure, (ax,) = axes_grid(1, 1, width=8.0, height=0.62 * len(found) + 0.9)
    base = found[0].outcome
    for at, contender in enumerate(found):
        ratio, low, high = contender.outcome.ratio(base)
        colour = COLOURS["published" if not at else "tuned" if at == len(found) - 1 else "other"]
        ax.barh(at, ratio, color=colour, height=0.6)
        ax.plot([low, high], [at, at], color=COLOURS["truth"], linewidth=1.2)
        note = f"  {ratio:.3g}, NEES per state {contender.outcome.nees:.2g}"
        ax.text(max(high, ratio), at, note, va="center", fontsize=8)
    ax.set_yticks(range(len(found)), [contender.name for contender in found], fontsize=8)
    ax.invert_yaxis()
    ax.axvline(1.0, color=COLOURS["truth"], linewidth=0.6)
    highest = max(c.outcome.ratio(base)[2] for c in found)
    if highest > 8.0:
        plain_log(ax, "x")
        ax.set_xlim(right=highest**1.7)
    else:
        ax.set_xlim(0.0, 1.5 * highest)
    ax.set_xlabel("held-out RMSE / published")
    ax.grid(False, axis="y")
    return figure
