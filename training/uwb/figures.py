"""The matrix of what was tuned on one run and run on another."""

from __future__ import annotations

from collections.abc import Mapping

from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure

from difffilter.reports.figures.style import axes_grid
from training.uwb.scores import ORDER, RUNS, own


def matrix_figure(numbers: Mapping[tuple[str, str], float]) -> Figure:
    """Rows tuned on, columns run on; light cells, white where a number is 1, dark text."""
    cells = [[numbers[name, run] for run in RUNS] for name in ORDER]
    reach = max(1.1, *(max(x, 1 / x) for line in cells for x in line))
    colours = LinearSegmentedColormap.from_list("transfer", ["#9ecae8", "#ffffff", "#f5b37a"])
    figure, (ax,) = axes_grid(1, 1, 6.0, 6.8)
    ax.pcolormesh(cells, cmap=colours, norm=LogNorm(1 / reach, reach), edgecolors="#dddddd")
    for i, name in enumerate(ORDER):
        for j, run in enumerate(RUNS):
            text = f"{cells[i][j]:.2f}" if cells[i][j] < 10 else f"{cells[i][j]:.0f}"
            frame = {"boxstyle": "square,pad=0.35", "fill": False, "edgecolor": "#222222"}
            ax.text(
                j + 0.5, i + 0.5, text, ha="center", va="center", fontsize=15,
                color="#111111", bbox=frame if own(name, run) else None,
            )  # fmt: skip
    ax.set_xticks([j + 0.5 for j in range(len(RUNS))], RUNS, fontsize=13)
    names = [name.replace(", ", ",\n") for name in ORDER]
    ax.set_yticks([i + 0.5 for i in range(len(ORDER))], names, fontsize=13)
    ax.tick_params(length=0)
    ax.xaxis.tick_top()
    ax.xaxis.set_label_position("top")
    ax.set_xlabel("run on", fontsize=13, labelpad=8)
    ax.set_ylabel("tuned on", fontsize=13)
    ax.invert_yaxis()
    ax.grid(False)
    ax.spines[:].set_visible(False)
    return figure
