"""Does it transfer? Values tuned in simulation or on some runs, run on every recorded run."""

from __future__ import annotations

from collections.abc import Mapping
from statistics import fmean
from typing import NamedTuple

from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.figure import Figure

import difffilter as df
from difffilter.reports.figures.style import axes_grid
from difffilter.reports.report import Report

RUNS = ("los_A1", "los_A2", "nlos_A1", "nlos_A2")
SIMULATED, SQUARED = "simulation", "simulation, squared error alone"
LASTING = "simulation, longer bursts"
HAND, OTHERS = "hand-picked", "the other three"
PAIRS = {"both LOS": RUNS[:2], "both NLOS": RUNS[2:]}
ORDER = (SIMULATED, SQUARED, LASTING, HAND, *RUNS, *PAIRS, OTHERS)
TUNED = ("motion.acceleration", "range.sigma", "imq.k")


class Score(NamedTuple):
    """What a set of values does on a run: RMSE in m, NEES per axis."""

    rmse: float
    nees: float


class Errors(NamedTuple):
    """Range errors without the wild ones: standard deviation in m, correlation at 1 s."""

    deviation: float
    correlation: float


#: By what the values were tuned on, and the run that they are run on.
Scores = Mapping[tuple[str, str], Score]


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


def own(tuned_on: str, run: str) -> bool:
    """Whether a run is among those that values were tuned on."""
    return run in PAIRS.get(tuned_on, (tuned_on,))


def transfer_rows(scores: Scores) -> list[list[object]]:
    """Every set of values on every run, run by run."""
    return [
        [run, name, row.rmse, row.rmse / scores[HAND, run].rmse, row.nees,
         "in-sample" if own(name, run) else ""]
        for run in RUNS
        for name in ORDER
        for row in [scores[name, run]]
    ]  # fmt: skip


def matrix_figure(numbers: Mapping[tuple[str, str], float]) -> Figure:
    """Rows tuned on, columns run on; light cells, white where a number is 1, dark text."""
    cells = [[numbers[name, run] for run in RUNS] for name in ORDER]
    reach = max(1.1, *(max(x, 1 / x) for line in cells for x in line))
    colours = LinearSegmentedColormap.from_list("transfer", ["#9ecae8", "#ffffff", "#f5b37a"])
    figure, (ax,) = axes_grid(1, 1, 6.0, 6.8)
    ax.pcolormesh(cells, cmap=colours, norm=LogNorm(1 / reach, reach), edgecolors="#dddddd")
    for i, name in enumerate(ORDER):
        for j, run in enumerate(RUNS):
            text = f"{cells[i][j]:.2f}" if cells[i][j] < 10 else f"{cells[i][j]:.0f}"
            frame = {"boxstyle": "square,pad=0.35", "fill": False, "edgecolor": "#222222"}
            ax.text(
                j + 0.5, i + 0.5, text, ha="center", va="center", fontsize=15,
                color="#111111", bbox=frame if own(name, run) else None,
            )  # fmt: skip
    ax.set_xticks([j + 0.5 for j in range(len(RUNS))], RUNS, fontsize=13)
    names = [name.replace(", ", ",\n") for name in ORDER]
    ax.set_yticks([i + 0.5 for i in range(len(ORDER))], names, fontsize=13)
    ax.tick_params(length=0)
    ax.xaxis.tick_top()
    ax.xaxis.set_label_position("top")
    ax.set_xlabel("run on", fontsize=13, labelpad=8)
    ax.set_ylabel("tuned on", fontsize=13)
    ax.invert_yaxis()
    ax.grid(False)
    ax.spines[:].set_visible(False)
    return figure


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


def to_hand(scores: Scores, name: str) -> dict[str, float]:
    """RMSE over that of the hand-picked values, by run."""
    return {run: scores[name, run].rmse / scores[HAND, run].rmse for run in RUNS}


def _span(numbers: Mapping[str, float]) -> str:
    return f"{min(numbers.values()):.2f} to {max(numbers.values()):.2f}"


def judge_transfer(report: Report, scores: Scores) -> None:
    """The claims about transfer."""
    ratios = to_hand(scores, SIMULATED)
    report.claim(
        "tuned in simulation, run on recordings: RMSE not more than 10 % above the hand-picked "
        "values in any run",
        max(ratios.values()) <= 1.1,
        ratios,
    )
    nees = {run: scores[SIMULATED, run].nees for run in RUNS}
    mean = fmean(nees.values())
    report.claim(
        "tuned in simulation, run on recordings: mean NEES per axis over the four runs between "
        "0.5 and 2.5",
        0.5 <= mean <= 2.5,
        {"mean": mean} | nees,
    )
    worst = {
        run: max(scores[name, run].rmse for name in RUNS if name != run) / scores[OTHERS, run].rmse
        for run in RUNS
    }
    report.claim(
        "tuned on any single run: RMSE on each other run within 25 % of the values tuned on all "
        "three others",
        max(worst.values()) <= 1.25,
        worst,
    )
