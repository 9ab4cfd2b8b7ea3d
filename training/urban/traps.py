"""Trust traps (paper 2): the surface of Figure 3, and how the traps narrow."""

from __future__ import annotations

import torch

from difffilter.adaptation.trust import credibility_share, trap_width, trust_gap
from difffilter.reports.figures.curves import curves_figure
from difffilter.reports.figures.surface import surface_figure
from difffilter.reports.report import Report
from training.urban.paper import SAYS


def trust_traps(report: Report) -> None:
    """Figure 3: the gap for two systems, how traps narrow with more, and eq. (16) checked."""
    report.heading("Trust traps")
    a = torch.linspace(-3.0, 4.0, 281, dtype=torch.float64)
    gap = trust_gap(a[None, :], a[:, None], 2)
    figure = surface_figure(
        {"two systems": gap.nan_to_num().tolist()}, a.tolist(), a.tolist(), "own error a",
        "other's error b", "gap in credibility", log=(False, False), columns=1, diverging=True,
    )  # fmt: skip
    caption = (
        "Figure 3: credibility from true minus from relative errors, in units of the prediction's "
        "error; blue: trusted too much. Eq. (16) alone: no filter, no trajectory"
    )
    report.figure(figure, "figure-3-trust-traps", caption, SAYS["figure 3"])
    line = torch.linspace(-1.0, 3.0, 401, dtype=torch.float64)
    curves = {
        f"N = {n}": trust_gap(line, torch.full_like(line, 0.1), n).tolist() for n in (2, 3, 5, 10)
    }
    figure = curves_figure(
        {"b = 0.1": (line.tolist(), curves)}, "own error a", "gap in credibility", markers=False,
        zero=False,
    )  # fmt: skip
    caption = (
        "Trust traps narrow as systems are added, b = 0.1. Eq. (16) alone: no filter, no trajectory"
    )
    report.figure(figure, "trust-traps-systems", caption, SAYS["systems"])
    width = {n: trap_width(0.1, n) for n in (2, 3, 5, 10, 20)}
    report.claim(
        "trust traps (gap below -0.5, b = 0.1) narrow as the number of systems grows",
        all(x > y for x, y in zip(list(width.values()), list(width.values())[1:], strict=False)),
        {f"N = {n}": value for n, value in width.items()},
    )
    generator = torch.Generator().manual_seed(0)
    a, b = 4.0 * torch.randn(2, 10_000, generator=generator, dtype=torch.float64)
    worst = 0.0
    for n in (2, 3, 7):
        direct = credibility_share(a, b, n) - credibility_share(a - 1.0, b - 1.0, n)
        worst = max(worst, float((trust_gap(a, b, n) - direct).abs().max()))
    report.claim(
        "eq. (16) is eq. (11) with the true errors minus eq. (11) with the relative ones",
        worst < 1e-9,
        {"largest difference, 10,000 points": worst},
    )
