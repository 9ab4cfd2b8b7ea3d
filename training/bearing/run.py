"""Airborne bearings-only location (paper 1): published against tuned, with and without outliers.

Regenerates figures 2 to 4 and the paper's claims, tunes the gated filter on Table 1's outliers,
on the multipath variant and where there are no outliers, and shows a lock-out with its recovery.
Writes report/airborne-bearing and the frozen values in checkpoints/.

    python -m training.bearing.run            # some minutes
    python -m training.bearing.run --quick    # under a minute, coarse
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import difffilter as df
from difffilter.reports.report import Report
from training.bearing.claims import judge
from training.bearing.equations import judge_equations
from training.bearing.figures import paper_figures
from training.bearing.paper import ITEMS, UNCHECKED
from training.bearing.tables import lock_out
from training.common import QUICK, Stages, arguments, checkpoint_path, values_table
from training.contents import contents

#: The multipath variant's drift, without multipath.
QUIET = {"faults.multipath.probability": 0.0}
#: What the paper's filter has; the multipath variant tunes a bias as well.
LISTED = {"parameters.bearing.bias.tuned": False}


def main() -> None:
    """Run the whole experiment."""
    options = arguments("airborne-bearing")
    quick, seed = options.quick, options.seed
    held_out = 30 if quick else 500
    runs, blocks = (30, 1) if quick else (1000, 10)
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

    tune = tuner(options)
    stages.next("tuning on the outliers of Table 1")
    tuned = {"outliers": tune(wild, wild.name)}
    stages.next("reference curves, figures 2 to 4")
    paper_figures(report, wild, clean, tuned["outliers"], seed=seed + 1, runs=runs, blocks=blocks)
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
    others: dict[str, dict[str, df.Checkpoint | None]] = {
        "multipath": {"tuned without bias": listed},
        "clean": {"tuned on outliers": tuned["outliers"], "tuned ekf": plain},
    }
    named = {"outliers": wild, "multipath": multipath, "clean": clean, "matched": matched}
    for key, scenario in named.items():
        values = {"published": None, "tuned": tuned[key], **others.get(key, {})}
        held_out_table(report, key, scenario, values, held_out, seed=seed + 2)
    quiet = multipath.with_overrides(QUIET)
    values = {"published": None, "tuned on multipath": tuned["multipath"],
              "tuned ekf": tune(quiet, None, system="ekf")}  # fmt: skip
    report.heading("What the values for multipath cost where there is none")
    report.comparison("no multipath", df.compare(quiet, values, held_out, seed + 2))
    lock_out(report, lockout, held_out, seed + 3)
    contents(report, ITEMS, UNCHECKED)
    stages.next(f"wrote {report.write()}")


def tuner(options: argparse.Namespace) -> Callable[..., df.Checkpoint]:
    """Tunes a scenario, and writes its values where they have a name."""
    small: dict[str, Any] = {}
    if options.quick:
        small = {"trajectories": 16, "validation": 16, "test": 16, "batch": 16, "steps": 3}

    def tune(scenario: df.Scenario, stem: str | None, **changes: Any) -> df.Checkpoint:
        out = checkpoint_path(stem, options) if stem else None
        settings = small | changes
        bar = not options.quiet
        return df.tune(
            scenario, seed=options.seed, settings=settings, out=out, progress=bar
        ).checkpoint

    return tune


def held_out_table(
    report: Report,
    key: str,
    scenario: df.Scenario,
    values: dict[str, df.Checkpoint | None],
    trajectories: int,
    *,
    seed: int,
) -> None:
    """Sets of values on held-out trajectories of one scenario, and what the tuned ones are."""
    table = df.compare(scenario, values, trajectories, seed)
    report.heading(f"Held out: {scenario.title}")
    report.text(f"{trajectories} trajectories, seed {seed}, seconds 50 to 200, frozen form.")
    report.comparison(key, table)
    tuned = values["tuned"]
    assert tuned is not None
    report.table(f"values, {key}", *values_table(tuned))
    judge(report, key, table)


if __name__ == "__main__":
    main()
