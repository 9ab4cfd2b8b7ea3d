"""Does it transfer? Values tuned in simulation or on some runs, run on every recorded run."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import fmean

import difffilter as df
from difffilter.reports.report import Report
from training.uwb.figures import matrix_figure
from training.uwb.scores import HAND, LASTING, ORDER, RUNS, SIMULATED, Errors, Scores, own, to_hand

TUNED = ("motion.acceleration", "range.sigma", "imq.k")


def transfer_tables(report: Report, sets: Mapping[str, df.Checkpoint], scores: Scores) -> None:
    """The values of each set, what each does on each run, and the matrix of that."""
    report.heading("Does it transfer?")
    report.text(
        "Rows name what the values were tuned on, by squared error and consistency except where "
        "they say otherwise; the scenario uwb-simulated assumes its numbers from data sheets, "
        "before any recording. longer bursts: delays last five times as long and begin a fifth as "
        "often, tried after the recordings were seen and so no prediction. in-sample: tuned on "
        "the run that they are run on."
    )
    values = [
        [name, *(float(frozen.values[key]) for key in TUNED)] for name, frozen in sets.items()
    ]
    report.table("transfer, values", ["tuned on", "q (m/s^2)", "sigma (m)", "k"], values)
    head = ["run on", "tuned on", "RMSE (m)", "ratio to hand-picked", "NEES per axis", "in-sample"]
    report.table("transfer", head, transfer_rows(scores))
    framed = "framed: in-sample (the run is among those tuned on)"
    ratio = {key: score.rmse / scores[key[1], key[1]].rmse for key, score in scores.items()}
    caption = f"RMSE divided by that of the values tuned on the run itself; {framed}"
    report.figure(matrix_figure(ratio), "transfer", caption)
    nees = {key: score.nees for key, score in scores.items()}
    caption = f"NEES per axis, 1 expected; {framed}"
    report.figure(matrix_figure(nees), "transfer-nees", caption)


def transfer_rows(scores: Scores) -> list[list[object]]:
    """Every set of values on every run, run by run."""
    return [
        [run, name, row.rmse, row.rmse / scores[HAND, run].rmse, row.nees,
         "in-sample" if own(name, run) else ""]
        for run in RUNS
        for name in ORDER
        for row in [scores[name, run]]
    ]  # fmt: skip


def finding(
    scores: Scores,
    process: Mapping[str, float],
    simulated: float,
    errors: Mapping[str, Errors],
) -> str:
    """What became of the values tuned in simulation, in words that the numbers choose.

    Args:
        process: by what they were tuned on, the process noise q.
        simulated: NEES per axis of the values tuned in simulation, in simulation.
        errors: of each run, of ``SIMULATED`` and of ``LASTING``.
    """
    nees = fmean(scores[SIMULATED, run].nees for run in RUNS)
    honest = "honest" if 0.5 <= nees <= 2.5 else "overconfident" if nees > 2.5 else "too cautious"
    ratios = to_hand(scores, SIMULATED)
    costs = "costs" if max(ratios.values()) > 1.1 else "costs little or no"
    recorded = fmean(errors[run].correlation for run in RUNS)
    wide = fmean(errors[run].deviation for run in RUNS)
    assumed, longer = errors[SIMULATED], errors[LASTING]
    whiter = "whiter than" if assumed.correlation < recorded - 0.1 else "about as coloured as"
    least, most = min(process[run] for run in RUNS), max(process[run] for run in RUNS)
    smooths = "smooths more than" if process[SIMULATED] < least else "smooths no more than"
    long_nees = fmean(scores[LASTING, run].nees for run in RUNS)
    return (
        f"Tuned in simulation, the covariance is {honest} on the recordings: NEES per axis "
        f"{nees:.2f} on average ({simulated:.2f} in simulation; hand-picked "
        f"{fmean(scores[HAND, run].nees for run in RUNS):.1f}). It {costs} accuracy: RMSE "
        f"{_span(ratios)} times that of the hand-picked values. "
        f"The assumed range errors are {whiter} the recorded ones: correlation after 1 s "
        f"{assumed.correlation:.2f} against {recorded:.2f}, standard deviation "
        f"{assumed.deviation:.2f} m against {wide:.2f} m, without errors over 1 m. "
        f"The filter tuned on them {smooths} those tuned on one run: q {process[SIMULATED]:.1f} "
        f"against {least:.1f} to {most:.1f} m/s^2. With longer bursts the correlation is "
        f"{longer.correlation:.2f}, q {process[LASTING]:.1f}, the RMSE "
        f"{_span(to_hand(scores, LASTING))} times that of the hand-picked values and the NEES "
        f"{long_nees:.2f}."
    )


def _span(numbers: Mapping[str, float]) -> str:
    return f"{min(numbers.values()):.2f} to {max(numbers.values()):.2f}"
