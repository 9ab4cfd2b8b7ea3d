"""Square-root cubature filters, adaptive, robust, fused (paper 4): published against tuned.

Regenerates the paper's tables and figures 2 to 8, checks its claims, compares all filters on
equal terms (the pooled measurement), tunes the fusion, the LCASRCKF and one pooled filter.
Writes report/manoeuvre-fusion and checkpoints/manoeuvre-fusion-1.json and -2.json.

    python -m training.manoeuvre.run            # some minutes
    python -m training.manoeuvre.run --quick    # under a minute, coarse
"""

from __future__ import annotations

from typing import Any

import difffilter as df
from difffilter.reports.report import Report
from training.common import QUICK, Stages, arguments, checkpoint_path, values_table
from training.contents import contents
from training.manoeuvre.claims import judge_claims, judge_more
from training.manoeuvre.paper import ITEMS, UNCHECKED
from training.manoeuvre.tables import Errors, errors, figures, gain, reference_table, track_panel

SCENES = ("manoeuvre-fusion-1", "manoeuvre-fusion-2")
POOLED = ("srckf", "robust-srckf", "lcasrckf", "stf-srckf", "rmckf")


def main() -> None:
    """Run the whole experiment."""
    options = arguments("manoeuvre-fusion")
    quick, seed = options.quick, options.seed
    runs = 10 if quick else 200
    small: dict[str, Any] = {}
    if quick:
        small = {"trajectories": 4, "validation": 4, "test": 4, "batch": 4, "steps": 1}
    settings = {"seed": seed, "held_out_trajectories": runs, "quick": quick}
    report = Report(options.out, "manoeuvre-fusion: published against tuned", settings)
    stages = Stages(7, options.quiet)
    scenarios = {name: df.load_scenario(name) for name in SCENES}
    first, second = scenarios.values()
    report.text(" ".join(first.notes) + QUICK * quick)

    stages.next("tables and figures")
    logs = {name: df.simulate(s, runs, seed + 1, "test") for name, s in scenarios.items()}
    found = {
        name: {system: errors(scenario, logs[name], system) for system in scenario.systems}
        for name, scenario in scenarios.items()
    }
    reference_table(report, found, runs, not quick)
    track_panel(report, second, logs[second.name])
    figures(report, found)
    judge_claims(report, *found.values())
    if not quick:
        judge_more(report, *found.values())

    def tune(scenario: df.Scenario, system: str, **changes: Any) -> df.Checkpoint:
        own = small | changes | {"system": system}
        bar = not options.quiet
        return df.tune(scenario, seed=seed, settings=own, progress=bar).checkpoint

    tuned: dict[tuple[str, str], df.Checkpoint] = {}
    for name, scenario in scenarios.items():
        stages.next(f"tuning the fusion and the LCASRCKF, {name}")
        tuned[name, "fusion"] = tune(scenario, "fusion")
        # Outliers make its loss nearly flat: noise of batches carries on where Gauss-Newton stops.
        tuned[name, "lcasrckf"] = tune(scenario, "lcasrckf", optimiser="adam")
        df.save(tuned[name, "fusion"], checkpoint_path(name, options))
    stages.next("tuning one filter on the pooled measurement")
    single = tune(second, "pooled-robust", optimiser="adam")  # a plateau, as the LCASRCKF's

    stages.next("held out")
    held = {name: df.simulate(s, runs, seed + 2, "test") for name, s in scenarios.items()}
    tuned_table(report, scenarios, held, tuned, not quick)
    single_table(report, scenarios, held, single, not quick)
    for (name, system), checkpoint in tuned.items():
        report.heading(f"Values of {system}, {name}")
        report.table(f"values, {system}, {name}", *values_table(checkpoint))
    stages.next("equal terms: every filter on the pooled measurement")
    equal_terms(report, scenarios, held)
    contents(report, ITEMS, {} if quick else UNCHECKED)
    stages.next(f"wrote {report.write()}")


def tuned_table(
    report: Report,
    scenarios: dict[str, df.Scenario],
    held: dict[str, df.Log],
    tuned: dict[tuple[str, str], df.Checkpoint],
    judged: bool,
) -> None:
    """Published and tuned values of fusion and LCASRCKF on held-out runs of both scenes."""
    report.heading("Held out: tuned values")
    report.text(
        "Mean over time of the RMSE over runs, averaged over x and y, in m; values are tuned on "
        "training runs of the same scene. RMS: root mean squared distance, what was minimised."
    )
    rows = []
    for (name, system), checkpoint in tuned.items():
        before = errors(scenarios[name], held[name], system)
        after = errors(scenarios[name], held[name], system, checkpoint.values)
        ratio, low, high = gain(after, before)
        rows.append([name, system, before.mean, after.mean, ratio, low, high, before.rms,
                     after.rms, before.nees, after.nees])  # fmt: skip
        if judged:
            report.claim(
                f"{name}: tuned {system} below its published mean RMSE, interval clear of 1",
                high < 1.0,
                {"tuned": after.mean, "published": before.mean, "ratio, 95 %": (low, high)},
            )
    head = ["scene", "system", "published (m)", "tuned (m)", "ratio", "low", "high",
            "RMS published (m)", "RMS tuned (m)", "NEES published", "NEES tuned"]  # fmt: skip
    report.table("tuned", head, rows)


def single_table(
    report: Report,
    scenarios: dict[str, df.Scenario],
    held: dict[str, df.Log],
    single: df.Checkpoint,
    judged: bool,
) -> None:
    """One filter on the pooled measurement, beside the published fusion."""
    report.heading("One filter on the pooled measurement")
    report.text(
        "pooled-robust: innovation matching, then prediction correction, on the three sensors "
        "as one; tuned once, on scene 2. Mean over time of the RMSE, averaged over x and y, in m."
    )
    rows, ratios = [], {}
    for name, scenario in scenarios.items():
        fusion = errors(scenario, held[name], "fusion")
        before = errors(scenario, held[name], "pooled-robust")
        after = errors(scenario, held[name], "pooled-robust", single.values)
        ratios[name] = after.mean / fusion.mean
        rows.append([name, fusion.mean, before.mean, after.mean, ratios[name], after.nees])
    head = ["scene", "fusion (m)", "hand-picked (m)", "tuned (m)", "tuned / fusion",
            "NEES per state"]  # fmt: skip
    report.table("single", head, rows)
    report.table("values, pooled-robust", *values_table(single))
    if judged:
        report.claim(
            "one filter tuned on the pooled measurement stays within 10 % of the fusion in both "
            "scenes",
            max(ratios.values()) <= 1.1,
            ratios,
        )


def equal_terms(report: Report, scenarios: dict[str, df.Scenario], held: dict[str, df.Log]) -> None:
    """The single filters with all three sensors as one, beside the fusion."""
    report.heading("On equal terms")
    report.text("Every filter on the pooled measurement; mean RMSE over time in m, x and y.")
    rows = []
    changes = {f"systems.{system}.sensors": ["pooled"] for system in POOLED}
    results: dict[str, dict[str, Errors]] = {}
    for name, scenario in scenarios.items():
        pooled = scenario.with_overrides(changes)
        results[name] = {f"{s} (pooled)": errors(pooled, held[name], s) for s in POOLED}
        results[name]["pooled-robust"] = errors(scenario, held[name], "pooled-robust")
        results[name]["fusion"] = errors(scenario, held[name], "fusion")
    for system in results[SCENES[0]]:
        one, two = (results[name][system] for name in SCENES)
        rows.append([system, *one.axes, *two.axes])
    report.table(
        "equal terms", ["system", "scene 1 x", "scene 1 y", "scene 2 x", "scene 2 y"], rows
    )


if __name__ == "__main__":
    main()
