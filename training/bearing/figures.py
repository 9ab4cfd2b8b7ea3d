"""The paper's table 1 and figures 2 to 4, and what it claims of them."""

from __future__ import annotations

import difffilter as df
from difffilter.reports.report import Report
from training.bearing.claims import judge_more, judge_paper
from training.bearing.tables import curves, outlier_table, reference_table, time_figure

__all__ = ["paper_figures"]


def paper_figures(
    report: Report,
    wild: df.Scenario,
    clean: df.Scenario,
    tuned: df.Checkpoint,
    *,
    seed: int,
    runs: int,
    blocks: int,
) -> None:
    """Published filters over time, with and without outliers, beside those tuned on outliers."""
    outlier_table(report, wild)
    report.heading("The published filters over time")
    found = {
        "clean": curves(clean, runs, seed, None, blocks),
        "wild": curves(wild, runs, seed, tuned, blocks),
    }
    for name, key in (("airborne-bearing-clean", "clean"), ("airborne-bearing", "wild")):
        reference_table(report, name, found[key], runs, blocks > 1)
    of = f"published values, {runs} trajectories"
    one = of
    if blocks > 1:
        of = f"published values, median over {blocks} blocks of {runs} trajectories"
        one = f"{of}, of least squares one block"
    time_figure(report, 2, "EKF against least squares, no outliers", found["clean"],
                ["ls", "weighted-ls", "ekf"], one)  # fmt: skip
    time_figure(report, 3, "no outliers", found["clean"],
                ["ekf", "robust", "gated", "robust-noise"], of)  # fmt: skip
    time_figure(report, 4, "outliers of Table 1", found["wild"],
                ["ekf", "robust", "gated", "ls", "gated tuned"],
                f"{one}; gated also with values tuned on these outliers")  # fmt: skip
    judge_paper(report, found["clean"], found["wild"])
    judge_more(report, found["clean"], found["wild"])
