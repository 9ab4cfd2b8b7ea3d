"""Airborne bearings-only location (paper 1): published against tuned, with and without outliers.

Regenerates figures 2 to 4 and the paper's claims, tunes the gated filter on Table 1's outliers,
on the multipath variant and where there are no outliers, and shows a lock-out with its recovery.
Writes report/airborne-bearing and the frozen values in checkpoints/.

    python -m training.bearing.run            # some minutes
    python -m training.bearing.run --quick    # under a minute, coarse
"""

from __future__ import annotations

from typing import Any

import difffilter as df
from difffilter.reports.report import Report
from training.bearing.claims import judge, judge_more, judge_paper
from training.bearing.equations import judge_equations
from training.bearing.paper import ITEMS, UNCHECKED
from training.bearing.tables import curves, lock_out, outlier_table, reference_table, time_figure
from training.common import QUICK, Stages, arguments, checkpoint_path, values_table
from training.contents import contents

#: The multipath variant's drift, without multipath.
QUIET = {"faults.multipath.probability": 0.0}
#: Everything that specification 1 lists; the multipath variant tunes a bias as well.
LISTED = {"parameters.bearing.bias.tuned": False}


def main() -> None:
    """Run the whole experiment."""
    options = arguments("airborne-bearing")
    quick, seed = options.quick, options.seed
    held_out = 30 if quick else 500
    runs, blocks = (30, 1) if quick else (1000, 10)
    small: dict[str, Any] = {}
    if quick:
        small = {"trajectories": 16, "validation": 16, "test": 16, "batch": 16, "steps": 3}
    settings = {
        "seed": seed,
        "held_out_trajectories": held_out,
        "runs": runs,
        "blocks": blocks,
        "quick": quick,
    }
    report = Report(options.out, "airborne-bearing: published against tuned", settings)
    stages = Stages(8, options.quiet)
    scenarios = {
        name: df.load_scenario(name)
        for name in (
            "airborne-bearing", "airborne-bearing-clean", "airborne-bearing-multipath",
            "airborne-bearing-matched", "gate-lockout",
        )
    }  # fmt: skip
    wild, clean, multipath, matched, lockout = scenarios.values()
    report.text(" ".join(wild.notes) + (QUICK if quick else ""))

    def tune(scenario: df.Scenario, stem: str | None, **changes: Any) -> df.Checkpoint:
        out = checkpoint_path(stem, options) if stem else None
        settings = small | changes
        bar = not options.quiet
        return df.tune(scenario, seed=seed, settings=settings, out=out, progress=bar).checkpoint

    stages.next("tuning on the outliers of Table 1")
    tuned = {"outliers": tune(wild, wild.name)}
    stages.next("reference curves, figures 2 to 4")
    outlier_table(report, wild)
    report.heading("The published filters over time")
    found = {
        "clean": curves(clean, runs, seed + 1, None, blocks),
        "wild": curves(wild, runs, seed + 1, tuned["outliers"], blocks),
    }
    for name, key in (("airborne-bearing-clean", "clean"), ("airborne-bearing", "wild")):
        reference_table(report, name, found[key], runs, not quick)
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
    judge_equations(report, matched, 20 if quick else 500, seed + 1)
    stages.next("tuning on multipath")
    tuned["multipath"] = tune(multipath, multipath.name)
    stages.next("tuning on multipath, without a bias")
    listed = tune(multipath.with_overrides(LISTED), None)
    stages.next("tuning without outliers")
    tuned["clean"] = tune(clean, clean.name)
    plain = tune(clean, None, system="ekf")
    stages.next("tuning where nothing can be won")
    tuned["matched"] = tune(matched, matched.name)

    stages.next("held-out comparisons")
    for key, scenario in {
        "outliers": wild, "multipath": multipath, "clean": clean, "matched": matched,
    }.items():  # fmt: skip
        values: dict[str, df.Checkpoint | None] = {"published": None, "tuned": tuned[key]}
        if key == "multipath":
            values["tuned without bias"] = listed
        if key == "clean":
            values |= {"tuned on outliers": tuned["outliers"], "tuned ekf": plain}
        table = df.compare(scenario, values, held_out, seed + 2)
        report.heading(f"Held out: {scenario.title}")
        report.text(f"{held_out} trajectories, seed {seed + 2}, seconds 50 to 200, frozen form.")
        report.comparison(key, table)
        report.table(f"values, {key}", *values_table(tuned[key]))
        judge(report, key, table)
    quiet = multipath.with_overrides(QUIET)
    values = {"published": None, "tuned on multipath": tuned["multipath"],
              "tuned ekf": tune(quiet, None, system="ekf")}  # fmt: skip
    report.heading("What the values for multipath cost where there is none")
    report.comparison("no multipath", df.compare(quiet, values, held_out, seed + 2))
    lock_out(report, lockout, held_out, seed + 3)
    contents(report, ITEMS, UNCHECKED)
    stages.next(f"wrote {report.write()}")


if __name__ == "__main__":
    main()
