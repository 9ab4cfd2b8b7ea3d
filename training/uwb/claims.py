"""The claims about recorded ranges, each judged by the numbers of this run."""

from __future__ import annotations

from statistics import fmean

import difffilter as df
from difffilter.reports.report import Report
from training.uwb.scores import BEST, LOSSES, OTHERS, RUNS, SIMULATED, Scores, to_hand


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
