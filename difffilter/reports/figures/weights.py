"""Weight and influence functions of every weight."""

from __future__ import annotations

from typing import Any

import torch
from matplotlib.figure import Figure

from difffilter.reports.figures.style import axes_grid
from difffilter.weights.registry import WEIGHTS

__all__ = ["weights_figure"]

#: Redescending to exactly 0, or with a bounded or slowly falling influence.
PANELS = {
    "bounded or slowly falling": ("plain", "huber", "cauchy", "imq", "student-t", "barron"),
    "rejecting": ("igg3", "tanh", "danish", "tukey", "welsch"),
}
_COLOURS = ["#999999", "#D55E00", "#0072B2", "#56B4E9", "#E69F00", "#CC79A7"]
_STYLES = ["-", "--", "-", "-.", ":", "--"]


def weights_figure(largest: float = 7.0) -> Figure:
    """w(s) above, the influence s w(s) below, at the declared clipping points.

    Args:
        largest: residual, in sigmas, up to which is drawn.
    """
    known = [name for names in PANELS.values() for name in names]
    panels = dict(PANELS)
    others = tuple(name for name in WEIGHTS if name not in known)
    if others:
        panels["others"] = others
    figure, axes = axes_grid(2, len(panels), width=4.6, height=2.9)
    s = torch.linspace(0.0, largest, 701, dtype=torch.float64)
    for column, (title, names) in enumerate(panels.items()):
        above, below = axes[column], axes[len(panels) + column]
        for i, name in enumerate(names):
            weight = WEIGHTS[name]
            w = weight(s, weight.prepare({p.name: p.tensor() for p in weight.parameters}))
            style: dict[str, Any] = {
                "color": _COLOURS[i % 6],
                "ls": _STYLES[i % 6],
                "lw": 1.6,
                "label": name,
            }
            above.plot(s, w, **style)
            below.plot(s, s * w, **style)
        above.set(title=title, ylabel="weight w(s)", ylim=(-0.03, 1.05))
        below.set(xlabel="standardised residual s", ylabel="influence s w(s)", ylim=(-0.1, 4.0))
        above.legend(fontsize=7)
    return figure
