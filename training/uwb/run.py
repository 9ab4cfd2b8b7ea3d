"""Recorded UWB ranges: tuned on three runs, tested on the fourth, in all four rotations.

Each rotation is tuned three times: by squared position error; without truth, by the
likelihood of the innovations; by squared error and consistency together. Every run starts
from its first measurements. Writes report/uwb-ranges and checkpoints/uwb-ranges.json (tuned
on all four runs, with the leave-one-out results). Then asks what transfers: values tuned in
simulation (checkpoints/uwb-simulated.json) and on one, two or three runs, on every run.

    python -m training.uwb.run            # some minutes
    python -m training.uwb.run --quick    # under a minute: the first 25 s of each run
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace

import torch

import difffilter as df
from difffilter.reports.figures.tracks import track_figure
from difffilter.reports.report import Report
from training.common import QUICK, Stages, arguments, checkpoint_path
from training.uwb.claims import judge
from training.uwb.scores import BEST, LOSSES, RUNS
from training.uwb.transfer import logs, transfer

#: Values that the table shows.
SHOWN = ("motion.acceleration", "range.sigma", "imq.k")


def main() -> int:
    """Run the whole experiment."""
    options = arguments("uwb-ranges", data=True)
    if not (options.data / "los_A1.csv").is_file():
        print(f"skipped: no recordings in {options.data} (see --data)")
        return 0
    scenario = df.load_scenario("uwb-ranges")
    quick = {"steps": 4, "window": 100, "evaluate_every": 4} if options.quick else {}
    settings = {"seed": options.seed, "quick": options.quick}
    report = Report(options.out, "uwb-ranges: hand-picked against tuned", settings)
    report.text(" ".join(scenario.notes) + (QUICK if options.quick else ""))
    stages = Stages(len(RUNS) + 4, options.quiet)

    rows: list[list[object]] = []
    scores: dict[tuple[str, str], df.Row] = {}
    rotated: dict[str, df.Checkpoint] = {}
    for run in RUNS:
        stages.next(f"tuned without {run}, tested on it")
        published, found = leave_out(run, scenario, options, quick, stages)
        for row in published.rows:
            rows.append([run, row.system, "hand-picked", row.rmse, row.nees_per_state, *[""] * 3])
        scores[run, "hand-picked"] = published.row("robust")
        for name, (row, checkpoint) in found.items():
            scores[run, name] = row
            values = [float(checkpoint.values[key]) for key in SHOWN]
            rows.append([run, "robust", f"tuned: {name}", row.rmse, row.nees_per_state, *values])
        rotated[run] = found[BEST][1]
        df.save(rotated[run], options.out / f"uwb-ranges-without-{run}.json")
        draw(report, run, logs(scenario, options, [run]), rotated[run])

    stages.next("tuned on all four runs")
    every = logs(scenario, options, list(RUNS))
    final = df.tune(
        scenario,
        every,
        validation=every,
        seed=options.seed,
        settings=quick,
        progress=not options.quiet,
    ).checkpoint
    left_out = {
        run: {
            "rmse": scores[run, BEST].rmse,
            "nees_per_state": scores[run, BEST].nees_per_state,
            "values": {name: value.tolist() for name, value in rotated[run].values.items()},
        }
        for run in RUNS
    }
    df.save(
        replace(final, result={"leave_one_run_out": left_out}),
        checkpoint_path("uwb-ranges", options),
    )
    stages.next("tables")
    held_out_table(report, scenario, rows)
    judge(report, scenario, scores)
    stages.next("what transfers, from simulation and from run to run")
    transfer(report, options, scenario, rotated, quick)
    stages.next(f"wrote {report.write()}")
    return 0


def leave_out(
    run: str,
    scenario: df.Scenario,
    options: argparse.Namespace,
    quick: dict[str, int],
    stages: Stages,
) -> tuple[df.Comparison, dict[str, tuple[df.Row, df.Checkpoint]]]:
    """Hand-picked values on a run, and those tuned on the others, with each loss."""
    train = logs(scenario, options, [name for name in RUNS if name != run])
    test = logs(scenario, options, [run])
    found = {}
    for name, loss in LOSSES.items():
        stages.detail(name)
        result = df.tune(
            scenario,
            train,
            validation=train,
            seed=options.seed,
            test=test,
            settings=quick | {"loss": loss},
            progress=not options.quiet,
        )
        assert result.held_out is not None
        found[name] = (result.held_out.row("robust", "tuned"), result.checkpoint)
    return df.compare(scenario, log=test), found


def held_out_table(report: Report, scenario: df.Scenario, rows: list[list[object]]) -> None:
    """Every set of values on every run, beside what others publish of it."""
    report.heading("Held-out runs")
    report.text(
        "Horizontal RMSE in m over the rows with at least one range, from the first measurement "
        "on; NEES per axis, 1 expected. The ESKF of the data's authors had an IMU as well."
    )
    rows = list(rows)
    for entry in scenario.references:
        rows.append([entry.run, entry.system, "published", entry.rmse, None, "", "", ""])
    rows.sort(key=lambda row: RUNS.index(str(row[0])))
    head = ["run", "system", "values", "RMSE (m)", "NEES per axis", "q (m/s^2)", "sigma (m)", "k"]
    report.table("held-out runs", head, rows)


def draw(report: Report, run: str, test: df.Log, checkpoint: df.Checkpoint) -> None:
    """Track, errors with 3-sigma bands and weights of a held-out run."""
    with torch.no_grad():
        track = df.run(checkpoint.filter, df.started(checkpoint.scenario, checkpoint.filter, test))
    caption = f"{run}, held out: tuned on the other three ({BEST})"
    report.figure(track_figure(test, track, 0, caption), f"run-{run}", caption)


if __name__ == "__main__":
    sys.exit(main())
