"""Interacting multiple models on the manoeuvres of paper 4: hand-picked and tuned, both scenes.

Tunes the mixtures and the fusion on scene 1, judges them on fresh held-out trajectories of both
scenes, beside the other filters on the same pooled measurement. Errors: RMSE over runs, mean over
time, then over x and y; ratios are paired, with a 95 % bootstrap interval over runs. Writes
report/manoeuvre-mixtures.

    python -m training.manoeuvre.mixtures            # some minutes
    python -m training.manoeuvre.mixtures --quick    # coarse
"""

from __future__ import annotations

import math
from typing import Any

import torch

import difffilter as df
from difffilter.reports.figures.modes import modes_figure
from difffilter.reports.report import Report
from training.common import QUICK, Stages, arguments, values_table
from training.manoeuvre.tables import Errors, errors, gain

SCENES = ("manoeuvre-fusion-1", "manoeuvre-fusion-2")
MIXTURES = ("imm", "imm-turns", "imm-turns-gated")
TUNED = (*MIXTURES, "fusion")
BESIDE = ("pooled-stf-srckf", "pooled-lcasrckf", "pooled-robust")
#: Added to the seed for the held-out trajectories: none of these was looked at while the modes
#: were chosen.
FRESH = 1000


def main() -> None:
    """Tune the mixtures and write the tables."""
    options = arguments("manoeuvre-mixtures")
    runs = 10 if options.quick else 200
    small: dict[str, Any] = {"trajectories": 128, "validation": 128, "test": 20, "steps": 30}
    if options.quick:
        small = {"trajectories": 4, "validation": 4, "test": 4, "batch": 4, "steps": 1}
    settings = {"seed": options.seed, "held_out_trajectories": runs, "quick": options.quick}
    report = Report(options.out, "manoeuvres: interacting multiple models", settings)
    report.text(
        "Tuned on scene 1, judged on held-out trajectories of both; in m, RMSE over runs, mean "
        "over time, then over x and y." + QUICK * options.quick
    )
    stages = Stages(len(TUNED) + 2, options.quiet)
    first = df.load_scenario(SCENES[0])
    tuned: dict[str, df.Checkpoint] = {}
    for system in TUNED:
        stages.next(f"tuning {system}")
        own = small | {"system": system}
        bar = not options.quiet
        tuned[system] = df.tune(first, seed=options.seed, settings=own, progress=bar).checkpoint
    stages.next("held out")
    seed = options.seed + FRESH
    for name in SCENES:
        scenario = df.load_scenario(name)
        log = df.simulate(scenario, runs, seed, "test")
        judge(report, scenario, log, tuned)
    rate = math.degrees(float(tuned["imm-turns"].values["motion.turn_rate"]))
    report.text(f"The turns of the world are at 3 deg/s; tuning found {rate:.3f} deg/s.")
    report.heading("Values")
    for system in MIXTURES:
        report.heading(system, 3)
        report.table(f"values, {system}", *values_table(tuned[system]))
    probabilities(report, first, df.simulate(first, 1, seed, "test"), tuned["imm-turns"])
    stages.next(f"wrote {report.write()}")


def judge(
    report: Report, scenario: df.Scenario, log: df.Log, tuned: dict[str, df.Checkpoint]
) -> None:
    """The table of one scene: all systems published, those that were tuned too."""
    best = errors(scenario, log, "fusion", tuned["fusion"].values)
    rows = []
    for system in (*TUNED, *BESIDE):
        found = {"published": errors(scenario, log, system)}
        if system in tuned:
            found["tuned"] = errors(scenario, log, system, tuned[system].values)
        for values, of in found.items():
            rows.append([system, values, f"{of.mean:.3f}", f"{of.nees:.2f}", _against(of, best)])
    head = ["system", "values", "error (m)", "NEES per state", "ratio to the tuned fusion"]
    report.heading(scenario.name)
    report.table(f"errors, {scenario.name}", head, rows)


def _against(mine: Errors, best: Errors) -> str:
    """The paired ratio and its interval; empty for the same."""
    if mine.squared is best.squared or torch.equal(mine.squared, best.squared):
        return ""
    ratio, low, high = gain(mine, best)
    return f"{ratio:.3f} ({low:.3f} to {high:.3f})"


def probabilities(
    report: Report, scenario: df.Scenario, log: df.Log, checkpoint: df.Checkpoint
) -> None:
    """Which mode held, over time, on one trajectory."""
    system = scenario.system("imm-turns")
    track = df.estimate(
        system, df.started(scenario, system, log, checkpoint.values), checkpoint.values
    )
    caption = "imm-turns, tuned: probabilities of the modes; turns at 30 to 60 s and 90 to 120 s"
    report.figure(modes_figure(track), "modes", caption)


if __name__ == "__main__":
    main()
