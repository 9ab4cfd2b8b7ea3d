"""Airport surface multilateration (paper 3): published against tuned, both NLOS readings.

Simulates, tunes, freezes, compares on held-out trajectories, regenerates the paper's
figures 6 to 9. Writes report/airport-mlat and the frozen values in checkpoints/.

    python -m training.airport.run            # a few minutes
    python -m training.airport.run --quick    # under a minute, coarse
"""

from __future__ import annotations

import difffilter as df
from difffilter.reports.report import Report
from training.airport.claims import judge, judge_comparison, judge_figures
from training.airport.figures import sweep_nlos, sweep_noise, windows_figure
from training.airport.paper import ITEMS, UNCHECKED
from training.airport.tables import REFERENCE, reference_table
from training.airport.tracks import tracks_figure
from training.common import QUICK, Stages, arguments, checkpoint_path, values_table
from training.contents import contents

LITERAL_50 = {"faults.nlos.scale": 50.0}


def main() -> None:
    """Run the whole experiment."""
    options = arguments("airport-mlat")
    quick, seed, bar = options.quick, options.seed, not options.quiet
    held_out = 20 if quick else 500
    small = {"trajectories": 16, "validation": 16, "test": 16, "steps": 4} if quick else {}
    settings = {"seed": seed, "held_out_trajectories": held_out, "quick": quick}
    title = "airport-mlat: published against tuned"
    report = Report(options.out, title, settings)
    stages = Stages(8, options.quiet)

    literal, intermittent = (df.load_scenario(f"airport-mlat{s}") for s in ("", "-intermittent"))
    literal50 = df.load_scenario("airport-mlat", LITERAL_50)
    report.text(" ".join(literal.notes) + (QUICK if quick else ""))

    stages.next("reference values")
    report.heading("Published filters: the reference values of both readings")
    reference_table(report, literal, REFERENCE, 20 if quick else 1000, seed + 1)

    tuned: dict[str, df.Checkpoint] = {}
    experiments = {
        "intermittent, 100 ns, p = 0.1": (intermittent, "airport-mlat-intermittent"),
        "literal, 50 ns": (literal50, "airport-mlat-literal-50ns"),
        "literal, 5 ns": (literal, "airport-mlat"),
    }
    for name, (scenario, stem) in experiments.items():
        stages.next(f"tuning {name}")
        out = checkpoint_path(stem, options)
        result = df.tune(scenario, seed=seed, settings=small, out=out, progress=bar)
        tuned[name] = result.checkpoint

        stages.detail("held-out comparison")
        values = {"published": None, "tuned": result.checkpoint}
        table = df.compare(scenario, values, held_out, seed + 2, progress=bar)
        report.heading(f"Held out: {name}")
        report.text(f"{held_out} trajectories, seed {seed + 2}, frozen hard form.")
        report.comparison(name, table)
        report.table(f"values, {name}", *values_table(result.checkpoint))
        judge(report, name, table)
        judge_comparison(report, name, table)

    stages.next("figure 6: track")
    worlds = {"literal, 50 ns": literal50, "intermittent, 100 ns": intermittent}
    report.heading("Figures of the paper")
    tracks_figure(report, worlds, tuned, seed)
    stages.next("figure 7: windows of 50 points")
    windows = windows_figure(report, worlds, tuned, seed, quick)
    stages.next("figures 8 and 9: noise levels")
    trajectories = 10 if quick else 100
    noise = sweep_noise(report, literal, tuned, seed, trajectories, quick)
    levels = sweep_nlos(report, literal, tuned, seed, trajectories, quick)
    judge_figures(report, windows, noise, levels)
    contents(report, ITEMS, UNCHECKED)
    stages.next(f"wrote {report.write()}")


if __name__ == "__main__":
    main()
