"""One look for all figures, and how they are written."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.text import Text
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

from difffilter.files import write_atomically

__all__ = ["COLOURS", "axes_grid", "plain_log", "save_figure"]

#: Colour-blind safe (Okabe and Ito): truth and bounds in black and grey, then the systems.
COLOURS = {
    "truth": "#000000",
    "published": "#D55E00",
    "tuned": "#0072B2",
    "clairvoyant": "#009E73",
    "other": "#999999",
}


def axes_grid(
    rows: int, columns: int, width: float = 5.2, height: float = 3.6
) -> tuple[Figure, list[Axes]]:
    """A figure with rows x columns axes, row by row."""
    figure = Figure(figsize=(width * columns, height * rows), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    flat = [ax for line in axes for ax in line]
    for ax in flat:
        ax.grid(True, linewidth=0.4, alpha=0.5)
        ax.spines[["top", "right"]].set_visible(False)
    return figure, flat


def plain_log(ax: Axes, which: str) -> None:
    """A logarithmic axis (``x`` or ``y``) with few labels, written out: 0.5, 2, 10."""
    ax.set(**{f"{which}scale": "log"})
    axis = getattr(ax, f"{which}axis")
    axis.set_major_locator(LogLocator(10.0, (1.0, 2.0, 5.0), numticks=6))
    axis.set_major_formatter(StrMethodFormatter("{x:.4g}"))
    axis.set_minor_formatter(NullFormatter())


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write PNG and SVG beside each other (any suffix of ``path`` is replaced)."""
    path = Path(path)
    for text in figure.findobj(Text):
        assert isinstance(text, Text)
        text.set_parse_math(False)  # a name of a file is no formula
    for suffix in (".png", ".svg"):
        buffer = BytesIO()
        metadata = {"Date": None} if suffix == ".svg" else None
        # A fixed salt: the same figure has the same ids, and the file the same bytes.
        with rc_context({"svg.hashsalt": "difffilter"}):
            figure.savefig(buffer, format=suffix[1:], dpi=130, metadata=metadata)
        write_atomically(path.with_suffix(suffix), buffer.getvalue())
