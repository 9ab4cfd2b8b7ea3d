"""Section of a verdict: where the gain comes from, and whether the gradient is worth it."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median

from tqdm import tqdm

from difffilter.comparison.table import labelled
from difffilter.logs.log import Log
from difffilter.reports.report import Report
from difffilter.tuning.search import SEARCHES, available
from difffilter.verdict.contests import SAMPLE, Course, contenders, contest
from difffilter.verdict.figures_contest import contest_figure, gain_figure
from difffilter.verdict.sections import Case

__all__ = ["write_contest"]

#: Held-out losses within this of each other are the same: half a percent of RMSE.
SAME = 0.01


def write_contest(
    report: Report, case: Case, train: Log | None, seeds: Sequence[int], progress: bool = False
) -> None:
    """Q and R alone against all values, then the gradient against searches.

    Args:
        train: recorded logs to train on; None for simulated trajectories.
        seeds: one tuning of each method for each; none leaves the section out.
    """
    held, checkpoint = case.held, case.checkpoint
    scenario, filter, settings = checkpoint.scenario, held.filter, checkpoint.scenario.tuning
    if not seeds or (scenario.world is None and train is None):
        why = "was not asked for" if not seeds else "needs the recordings to train on"
        report.text(f"Left out: the contest of tuners {why}.")
        return
    found = contenders(
        scenario, filter, settings, held, checkpoint.values,
        seed=seeds[0], log=train, engine=held.engine,
    )  # fmt: skip
    caption = (
        "Where the gain comes from: Q and R alone, as others estimate them and by the gradient, "
        "with clipping points, gates, biases and credibility as published; then these alone; "
        "then all (line: paired 95 % interval)"
    )
    report.figure(gain_figure(found), f"{case.slug}-gain", caption)
    rows = [
        [c.name, c.outcome.rmse, *_ratio(c.outcome.ratio(found[0].outcome)), c.outcome.nees]
        for c in found
    ]
    head = ["what is estimated, and how", labelled("RMSE", case.published.unit),
            "ratio to published", "95 % interval", "NEES per state"]  # fmt: skip
    report.table(f"{case.slug} gain", head, rows)

    if SAMPLE not in [contender.name for contender in found]:
        report.text("No sample covariances: the truth does not tell every state, or Q and R are "
                    "not tuned here.")  # fmt: skip
    methods = [name for name in SEARCHES if available(name)]
    for name in SEARCHES:
        if name not in methods:
            report.text(f"Not run: {name}, whose package is not installed.")
    total = len(seeds) * (1 + len(methods))
    courses = list(
        tqdm(
            contest(scenario, filter, settings, held, seeds=seeds, methods=methods, log=train,
                    engine=held.engine),
            desc="contest", total=total, unit="tuning", delay=2.0, disable=not progress,
        )
    )  # fmt: skip
    caption = (
        f"Held-out loss of the best values so far, {len(seeds)} tuning"
        f"{'s' if len(seeds) > 1 else ''} each, from the same start on the same data with the "
        "same budget of filter runs; one run with p derivatives counts as 1 + p"
    )
    report.figure(contest_figure(courses), f"{case.slug}-contest", caption)
    _table(report, case, courses)


def _table(report: Report, case: Case, courses: Sequence[Course]) -> None:
    gradient = {c.seed: c for c in courses if c.method not in SEARCHES}
    rows, words = [], []
    for method in dict.fromkeys(course.method for course in courses):
        own = [course for course in courses if course.method == method]
        at_seconds = [c.loss[c.at(seconds=gradient[c.seed].seconds[-1])] for c in own]
        final = median(c.loss[-1] for c in own)
        rows.append([
            method, median(c.runs[-1] for c in own), median(c.seconds[-1] for c in own),
            median(c.loss[0] for c in own), median(at_seconds), final,
            median(c.rmse[-1] for c in own),
        ])  # fmt: skip
        if method in SEARCHES:
            best = median(c.loss[-1] for c in gradient.values())
            late = median(c.seconds[-1] / gradient[c.seed].seconds[-1] for c in own)
            words.append(f"{method} ends {_beside(final - best)} after {late:.1f} times the time")
    head = ["method", "filter runs", "seconds", "loss published", "loss at the gradient's time",
            "loss at the end", labelled("RMSE at the end", case.published.unit)]  # fmt: skip
    report.table(f"{case.slug} contest", head, rows)
    if words:
        report.text(f"Against the gradient, with as many filter runs: {'; '.join(words)}.")


def _beside(difference: float) -> str:
    """A held-out loss beside the gradient's."""
    if abs(difference) <= SAME:
        return "level"
    return f"{abs(difference):.3f} {'worse' if difference > 0.0 else 'better'}"


def _ratio(ratio: tuple[float, float, float]) -> tuple[float, tuple[float, float]]:
    return ratio[0], ratio[1:]
