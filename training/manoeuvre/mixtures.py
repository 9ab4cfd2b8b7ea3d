"""Interacting multiple models on the manoeuvres of paper 4: hand-picked and tuned, both scenes.

Tunes on scene 1, judges on held-out trajectories of both scenes, beside the fusion and the strong
tracking filter on the same pooled measurement. Errors: RMSE over runs, mean over time, then over x
and y. Writes report/manoeuvre-mixtures.

    python -m training.manoeuvre.mixtures            # some minutes
    python -m training.manoeuvre.mixtures --quick    # coarse
"""

from __future__ import annotations

import math
from typing import Any

import difffilter as df
from difffilter.reports.report import Report
from training.common import QUICK, Stages, arguments
from training.manoeuvre.tables import errors

SCENES = ("manoeuvre-fusion-1", "manoeuvre-fusion-2")
MIXTURES = ("imm", "imm-turns", "imm-turns-gated")
BESIDE = ("fusion", "pooled-stf-srckf", "pooled-lcasrckf")


def main() -> None:
    """Tune the mixtures and write the table."""
    options = arguments("manoeuvre-mixtures")
    runs = 10 if options.quick else 200
    small: dict[str, Any] = {"trajectories": 128, "validation": 128, "test": runs, "steps": 30}
    if options.quick:
        small = {"trajectories": 4, "validation": 4, "test": 4, "batch": 4, "steps": 1}
    settings = {"seed": options.seed, "held_out_trajectories": runs, "quick": options.quick}
    report = Report(options.out, "manoeuvres: interacting multiple models", settings)
    report.text(QUICK * options.quick)
    stages = Stages(len(MIXTURES) + 2, options.quiet)
    first = df.load_scenario(SCENES[0])
    tuned = {}
    for system in MIXTURES:
        stages.next(f"tuning {system}")
        tuned[system] = df.tune(
            first, seed=options.seed, settings=small | {"system": system},
            progress=not options.quiet,
        ).checkpoint  # fmt: skip
    stages.next("held out")
    rows = []
    for name in SCENES:
        scenario = df.load_scenario(name)
        log = df.simulate(scenario, runs, options.seed + 2, "test")
        for system in (*MIXTURES, *BESIDE):
            published = errors(scenario, log, system)
            row = [name, system, f"{published.mean:.2f}", "", f"{published.nees:.2f}", ""]
            if system in tuned:
                own = errors(scenario, log, system, tuned[system].values)
                row[3], row[5] = f"{own.mean:.2f}", f"{own.nees:.2f}"
            rows.append(row)
    head = ["scene", "system", "published (m)", "tuned (m)", "NEES, published", "NEES, tuned"]
    report.table("errors of the mixtures", head, rows)
    rate = math.degrees(float(tuned["imm-turns"].values["motion.turn_rate"]))
    report.text(f"The turns of the world are at 3 deg/s; tuning found {rate:.3f} deg/s.")
    stages.next(f"wrote {report.write()}")


if __name__ == "__main__":
    main()
