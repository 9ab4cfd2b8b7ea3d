"""Which weight: every weight function on clean, contaminated and recorded data, as published
and tuned.

Writes report/weights; docs/make/readme.py puts its tables into docs/weights.md.

    python -m docs.make.weights            # some minutes
    python -m docs.make.weights --quick    # under a minute, coarse
"""

from __future__ import annotations

from typing import Any

import difffilter as df
from difffilter.reports.figures.weights import weights_figure
from difffilter.reports.report import Report
from training.common import QUICK, Stages, arguments

#: An emitter that hardly drifts, as the filter knows: the bearings' noise decides the errors.
STEADY = {"world.acceleration.sigma": 0.002, "parameters.motion.acceleration.value": 0.002}
#: Without outliers, with large ones of either sign, with smaller ones to one side.
WORLDS: dict[str, dict[str, Any]] = {
    "clean": {"faults.wild.probability": 0.0},
    "two-sided": {},
    "one-sided": {
        "faults.wild.low": 2.0,
        "faults.wild.high": 10.0,
        "faults.wild.two_sided": False,
        "faults.wild.probability": 0.15,
    },
}
#: Anchors stand elsewhere in A1 than in A2: tuned on one layout, tested on the other.
FOLDS = {"A2": ("los_A1", "nlos_A1"), "A1": ("los_A2", "nlos_A2")}


def main() -> None:
    """Run the whole experiment."""
    options = arguments("weights", data=True)
    quick, seed = options.quick, options.seed
    runs = 20 if quick else 1000
    report = Report(options.out, "Which weight?", {"seed": seed, "runs": runs, "quick": quick})
    recorded = (options.data / "los_A1.csv").is_file()
    stages = Stages(3 + recorded, options.quiet)
    report.text("Every weight function, at its published and at tuned values." + QUICK * quick)
    report.figure(weights_figure(), "weights", "Weight and influence functions, default values")

    stages.next("published clipping points")
    published(report, runs, seed)
    stages.next("tuned on multipath")
    multipath(report, runs, seed, quick)
    if recorded:
        stages.next("tuned on recorded ranges")
        ranges(report, options, seed, quick)
    stages.next(f"wrote {report.write()}")


def weighing(name: str, tuned: bool = True) -> dict[str, Any]:
    """Overrides that add a system ``weighed`` with a weight function, and that tune it."""
    changes: dict[str, Any] = {"systems.weighed.weight": name, "tuning.system": "weighed"}
    for parameter in df.WEIGHTS[name].parameters:
        value = parameter.tensor().tolist()
        changes[f"parameters.{parameter.name}"] = {"value": value, "tuned": tuned}
    return changes


def published(report: Report, runs: int, seed: int) -> None:
    """Cost on clean data, saving on contaminated data, at the default clipping points."""
    base = df.load_scenario("airborne-bearing-matched", STEADY)
    rows = []
    told, plain = {}, {}
    for world, changes in WORLDS.items():
        table = df.compare(base.with_overrides(changes), None, runs, seed + 1,
                           systems=("ekf", "clairvoyant"))  # fmt: skip
        plain[world], told[world] = table.row("ekf").rmse, table.row("clairvoyant").rmse
    for name in df.WEIGHTS:
        error = {}
        for world, changes in WORLDS.items():
            scenario = base.with_overrides(changes | weighing(name))
            table = df.compare(scenario, None, runs, seed + 1, systems=("weighed",))
            error[world] = table.row("weighed")
        efficiency = 100.0 * (plain["clean"] / error["clean"].rmse) ** 2
        rows.append(
            [
                name,
                efficiency,
                *(error[w].rmse for w in WORLDS),
                *(error[w].rmse / told[w] for w in ("two-sided", "one-sided")),
                error["two-sided"].nees_per_state,
            ]
        )
    report.heading("At the default clipping points")
    report.text(
        f"Bearings of an emitter that hardly drifts (airborne-bearing-matched with 0.002 m/s^2), "
        f"{runs} runs, position RMSE in m over 50 to 200 s, noise values as in the world. "
        "Efficiency: mean squared error of the "
        "plain filter over that of the weight, on clean data. Two-sided: 8 % of the bearings off "
        "by 5 to 25 sigma; one-sided: 15 % by 2 to 10 sigma. The clairvoyant knows which."
    )
    head = ["weight", "efficiency (%)", *(f"{w} (m)" for w in WORLDS), "two-sided / clairvoyant",
            "one-sided / clairvoyant", "NEES per state, two-sided"]  # fmt: skip
    rows.append(["clairvoyant", 100.0, *(told[w] for w in WORLDS), 1.0, 1.0, None])
    report.table("published", head, rows)


def multipath(report: Report, runs: int, seed: int, quick: bool) -> None:
    """Every weight tuned on the multipath variant."""
    settings: dict[str, Any] = {"trajectories": 512, "validation": 512, "steps": 60, "batch": 128}
    if quick:
        settings = {"trajectories": 8, "validation": 8, "test": 4, "batch": 8, "steps": 1}
    base = df.load_scenario("airborne-bearing-multipath")
    told = df.compare(base, None, runs, seed + 2, systems=("clairvoyant",)).row("clairvoyant")
    rows = []
    for name in df.WEIGHTS:
        scenario = base.with_overrides(weighing(name))
        done = df.tune(scenario, seed=seed, settings=settings | {"test": 4}).checkpoint
        table = df.compare(scenario, {"published": None, "tuned": done}, runs, seed + 2,
                           systems=("weighed",))  # fmt: skip
        before, after = table.row("weighed"), table.row("weighed", "tuned")
        rows.append(
            [name, before.rmse, after.rmse, after.ci95[0], after.ci95[1], after.rmse / told.rmse,
             after.nees_per_state, chosen(done, name)]
        )  # fmt: skip
    rows.append(["clairvoyant", told.rmse, None, *told.ci95, 1.0, told.nees_per_state, ""])
    report.heading("Each tuned on the multipath variant")
    report.text(
        f"airborne-bearing-multipath, {runs} held-out runs, position RMSE in m over 50 to 200 s. "
        "Tuned are the weight's own parameters, the noise levels, the bias and the start."
    )
    head = ["weight", "published (m)", "tuned (m)", "low", "high", "tuned / clairvoyant",
            "NEES per state", "clipping points"]  # fmt: skip
    report.table("multipath", head, rows)


def ranges(report: Report, options: Any, seed: int, quick: bool) -> None:
    """Every weight tuned on recorded ranges of one anchor layout, tested on the other."""
    settings: dict[str, Any] = {"steps": 2 if quick else 30}
    base = df.load_scenario("uwb-ranges")
    rows = []
    for name in df.WEIGHTS:
        scenario = base.with_overrides(weighing(name))
        row: list[Any] = [name]
        for train in FOLDS.values():
            test = next(other for other in FOLDS.values() if other != train)
            logs = {part: load(scenario, options, part, quick) for part in (train, test)}
            own = logs[train]
            done = df.tune(
                scenario, own, validation=own, test=logs[test], seed=seed, settings=settings
            )
            assert done.held_out is not None
            before, after = (done.held_out.row("weighed", v) for v in ("published", "tuned"))
            row += [before.rmse, after.rmse, after.nees_per_state, chosen(done.checkpoint, name)]
        rows.append(row)
    report.heading("Each tuned on recorded ranges")
    report.text(
        "uwb-ranges, horizontal RMSE in m and NEES per axis: tuned on the two runs of one layout "
        "of the anchors, tested on the two of the other."
    )
    head = ["weight"]
    for fold in FOLDS:
        head += [f"{fold}: default (m)", f"{fold}: tuned (m)", f"{fold}: NEES per axis",
                 f"{fold}: clipping points"]  # fmt: skip
    report.table("ranges", head, rows)


def load(scenario: df.Scenario, options: Any, runs: tuple[str, ...], quick: bool) -> df.Log:
    """The recordings; the first 100 rows of each in a quick run."""
    log = df.load_logs(scenario, [options.data / f"{run}.csv" for run in runs])
    return log.rows(0, 100) if quick else log


def chosen(checkpoint: df.Checkpoint, name: str) -> str:
    """The weight's own values."""
    values = [checkpoint.values[p.name] for p in df.WEIGHTS[name].parameters]
    return ", ".join(f"{float(entry):.2f}" for value in values for entry in value.reshape(-1))


if __name__ == "__main__":
    main()
