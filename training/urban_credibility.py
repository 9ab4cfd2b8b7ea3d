"""Credibility-weighted federated fusion (paper 2): FSP, filtering ratio, trust traps.

Regenerates Table 1 and figures 3 and 4, draws the FSP surface, tunes the credibility mapping
over all four scenes, and runs the variants with two axes and with a faulty third system.
Writes report/urban-credibility and checkpoints/urban-credibility.json.

    python training/urban_credibility.py            # some minutes
    python training/urban_credibility.py --quick    # under a minute, coarse
"""

from __future__ import annotations

from typing import Any

import torch
from common import QUICK, Stages, arguments, checkpoint_path, values_table
from papers import contents
from urban_claims import ITEMS, UNCHECKED, judge_paper
from urban_equations import judge_equations
from urban_tables import error_figure, fsp_figure, table_1, variants
from urban_traps import trust_traps

import difffilter as df
from difffilter.comparison.optimality import fsp, ratio_gain
from difffilter.reports.report import Report


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


def judge(report: Report, found: dict[str, Any]) -> None:
    """What tuning bought, over all four scenes."""
    ideal, published = found["ideal"], found["credibility"]
    for name in ("tuned", "tuned mapping alone"):
        gain = ratio_gain(found[name], published, ideal)
        worst = max(gain.per_scene.values())
        numbers = {"gain": gain.gain, "gain, 95 %": gain.ci95}
        numbers |= {f"RMSE, scene {scene}": change for scene, change in gain.per_scene.items()}
        if name == "tuned":
            report.claim(
                "tuned: the mean optimal filtering ratio rises by at least 15 %, no scene more "
                "than 3 % worse",
                gain.gain >= 0.15 and gain.ci95[0] > 0.0 and worst <= 0.03,
                numbers,
            )
        else:
            report.claim(
                "without the credibility of the prediction little can be won (below 5 %)",
                gain.gain < 0.05,
                numbers,
            )


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
