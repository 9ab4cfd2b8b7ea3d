"""Credibility-weighted federated fusion (paper 2): FSP, filtering ratio, trust traps.

Regenerates Table 1 and figures 3 and 4, draws the FSP surface, tunes the credibility mapping
over all four scenes, and runs the variants with two axes and with a faulty third system.
Writes report/urban-credibility and checkpoints/urban-credibility.json.

    python -m training.urban.run            # some minutes
    python -m training.urban.run --quick    # under a minute, coarse
"""

from __future__ import annotations

from typing import Any

import torch

import difffilter as df
from difffilter.comparison.optimality import fsp
from difffilter.reports.report import Report
from training.common import QUICK, Stages, arguments, checkpoint_path, values_table
from training.contents import contents
from training.urban.claims import judge, judge_paper
from training.urban.equations import judge_equations
from training.urban.paper import ITEMS, UNCHECKED
from training.urban.tables import error_figure, fsp_figure, table_1, variants
from training.urban.traps import trust_traps


def main() -> None:
    """Run the whole experiment."""
    options = arguments("urban-credibility")
    quick, seed = options.quick, options.seed
    runs = 8 if quick else 200
    small: dict[str, Any] = {}
    if quick:
        small = {"trajectories": 4, "validation": 4, "test": 4, "batch": 4, "steps": 1}
    settings = {"seed": seed, "held_out_trajectories": runs, "quick": quick}
    report = Report(options.out, "urban-credibility: published against tuned", settings)
    stages = Stages(7, options.quiet)
    scenario = df.load_scenario("urban-credibility")
    report.text(" ".join(scenario.notes) + QUICK * quick)

    stages.next("tuning the mapping and the credibility of the prediction")
    out = checkpoint_path(scenario.name, options)
    tuned = df.tune(
        scenario, seed=seed, settings=small, out=out, progress=not options.quiet
    ).checkpoint

    stages.next("tuning without the credibility of the prediction")
    fixed = {"parameters.credibility.kappa.tuned": False,
             "parameters.credibility.drift_rate.tuned": False}  # fmt: skip
    mapping = tuned
    if not quick:
        mapping = df.tune(
            scenario.with_overrides(fixed), seed=seed, progress=not options.quiet
        ).checkpoint

    stages.next("table 1 and filtering ratios")
    log = df.simulate(scenario, runs, seed + 2, "test")
    found = {name: fsp(scenario, log, name) for name in ("standard", "credibility", "ideal")}
    found |= {
        "tuned mapping alone": fsp(scenario, log, "credibility", mapping.values),
        "tuned": fsp(scenario, log, "credibility", tuned.values),
    }
    table_1(report, found, runs, judged=not quick)
    report.table("values", *values_table(tuned))
    judge(report, found)
    judge_paper(report, found)
    judge_equations(report)
    values = {"published": None, "tuned": tuned}
    report.heading("Held out")
    report.comparison("held out", df.compare(scenario, values, runs, seed + 2))
    stages.next("figure 4: errors over time")
    error_figure(report, scenario, log, tuned)
    stages.next("FSP surface")
    fsp_figure(report, scenario, tuned, seed + 3, 4 if quick else 40, 2 if quick else 7)
    stages.next("trust traps, variants")
    trust_traps(report)
    variants(report, tuned, 4 if quick else runs, seed + 4, not quick)
    contents(report, ITEMS, UNCHECKED)
    stages.next(f"wrote {report.write()}")


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
