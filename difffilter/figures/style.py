"""One look for all figures, and how they are written."""

from __future__ import annotations

from io import BytesIO
from pathlib import Path

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from difffilter.files import write_atomically

__all__ = ["COLOURS", "axes_grid", "save_figure"]

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


def save_figure(figure: Figure, path: str | Path) -> None:
    """Write PNG and SVG beside each other (any suffix of ``path`` is replaced)."""
    path = Path(path)
    for suffix in (".png", ".svg"):
        buffer = BytesIO()
        metadata = {"Date": None} if suffix == ".svg" else None
        # A fixed salt: the same figure has the same ids, and the file the same bytes.
        with rc_context({"svg.hashsalt": "difffilter"}):
            figure.savefig(buffer, format=suffix[1:], dpi=130, metadata=metadata)
        write_atomically(path.with_suffix(suffix), buffer.getvalue())
