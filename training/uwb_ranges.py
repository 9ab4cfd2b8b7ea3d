"""Recorded UWB ranges: tuned on three runs, tested on the fourth, in all four rotations.

Each rotation is tuned three times: by squared position error; without truth, by the
likelihood of the innovations; by squared error and consistency together. Every run starts
from its first measurements. Writes report/uwb-ranges and checkpoints/uwb-ranges.json (tuned
on all four runs, with the leave-one-out results). Then asks what transfers: values tuned in
simulation (checkpoints/uwb-simulated.json) and on one, two or three runs, on every run.

    python training/uwb_ranges.py            # some minutes
    python training/uwb_ranges.py --quick    # under a minute: the first 25 s of each run
"""

from __future__ import annotations

import sys
from dataclasses import replace

import torch
from common import QUICK, Stages, arguments, checkpoint_path
from uwb_tables import RUNS
from uwb_transfer import logs, transfer

import difffilter as df
from difffilter.reports.figures.tracks import track_figure
from difffilter.reports.report import Report

LOSSES = {
    "squared error": {"position": 1.0},
    "likelihood, no truth": {"likelihood": 1.0},
    "squared error and consistency": {"position": 1.0, "consistency": 0.1},
}
BEST = "squared error and consistency"


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

    rows, scores, rotated = [], {}, {}
    for run in RUNS:
        stages.next(f"tuned without {run}, tested on it")
        train = logs(scenario, options, [name for name in RUNS if name != run])
        test = logs(scenario, options, [run])
        published = df.compare(scenario, log=test)
        for row in published.rows:
            rows.append([run, row.system, "hand-picked", row.rmse, row.nees_per_state, *[""] * 3])
        scores[run, "hand-picked"] = published.row("robust")
        for name, loss in LOSSES.items():
            stages.detail(name)
            result = df.tune(
                scenario,
                seed=options.seed,
                log=train,
                test=test,
                settings=quick | {"loss": loss},
                progress=not options.quiet,
            )
            assert result.held_out is not None
            row = result.held_out.row("robust", "tuned")
            scores[run, name] = row
            values = [
                float(result.checkpoint.values[key])
                for key in ("motion.acceleration", "range.sigma", "imq.k")
            ]
            rows.append([run, "robust", f"tuned: {name}", row.rmse, row.nees_per_state, *values])
            if name == BEST:
                rotated[run] = result.checkpoint
                df.save(result.checkpoint, options.out / f"uwb-ranges-without-{run}.json")
                draw(report, run, test, result.checkpoint)

    stages.next("tuned on all four runs")
    every = logs(scenario, options, list(RUNS))
    final = df.tune(
        scenario, seed=options.seed, log=every, settings=quick, progress=not options.quiet
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
    report.heading("Held-out runs")
    report.text(
        "Horizontal RMSE in m over the rows with at least one range, from the first measurement "
        "on; NEES per axis, 1 expected. The ESKF of the data's authors had an IMU as well."
    )
    for entry in scenario.references:
        rows.append([entry.run, entry.system, "published", entry.rmse, None, "", "", ""])
    rows.sort(key=lambda row: RUNS.index(row[0]))
    head = ["run", "system", "values", "RMSE (m)", "NEES per axis", "q (m/s^2)", "sigma (m)", "k"]
    report.table("held-out runs", head, rows)
    judge(report, scenario, scores)
    stages.next("what transfers, from simulation and from run to run")
    transfer(report, options, scenario, rotated, quick)
    stages.next(f"wrote {report.write()}")
    return 0


def draw(report: Report, run: str, test: df.Log, checkpoint: df.Checkpoint) -> None:
    """Track, errors with 3-sigma bands and weights of a held-out run."""
    with torch.no_grad():
        track = df.run(checkpoint.filter, df.started(checkpoint.scenario, checkpoint.filter, test))
    caption = f"{run}, held out: tuned on the other three ({BEST})"
    report.figure(track_figure(test, track, 0, caption), f"run-{run}", caption)


def judge(report: Report, scenario: df.Scenario, scores: dict[tuple[str, str], df.Row]) -> None:
    """The claims that the rotations decide."""
    eskf = {entry.run: entry.rmse for entry in scenario.references}
    error, likelihood, both = ({run: scores[run, name].rmse for run in RUNS} for name in LOSSES)
    report.claim(
        "tuned by squared error: at least 10 % below the ESKF (UWB + IMU) in each rotation",
        all(error[run] <= 0.9 * eskf[run] for run in RUNS),
        {run: f"{error[run]:.3f} of {eskf[run]:.3f}" for run in RUNS},
    )
    report.claim(
        "tuned without truth: within 25 % of that",
        all(likelihood[run] <= 1.25 * error[run] for run in RUNS),
        {run: likelihood[run] / error[run] for run in RUNS},
    )
    nees = [scores[run, BEST].nees_per_state for run in RUNS]
    report.claim(
        "tuned with consistency: mean NEES per axis over the four runs between 0.5 and 2.5",
        0.5 <= sum(nees) / 4 <= 2.5,
        {"mean": sum(nees) / 4} | dict(zip(RUNS, nees, strict=True)),
    )
    report.claim(
        "tuned with consistency: RMSE within 15 % of the best",
        all(both[run] <= 1.15 * min(error[run], likelihood[run], both[run]) for run in RUNS),
        {run: both[run] / min(error[run], likelihood[run], both[run]) for run in RUNS},
    )
    gain = {run: error[run] / scores[run, "hand-picked"].rmse for run in RUNS}
    report.claim("tuned by squared error: below the hand-picked values in each rotation",
                 all(ratio < 1.0 for ratio in gain.values()), gain)  # fmt: skip


if __name__ == "__main__":
    sys.exit(main())
