"""The verdict on a checkpoint from logs without truth: what it foretells, and what nobody knows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from difffilter.comparison.questions import NEXT, QUESTIONS
from difffilter.comparison.without_truth import (
    UNKNOWABLE,
    Answer,
    ChannelCheck,
    Untold,
    compare_without_truth,
)
from difffilter.logs.log import Log
from difffilter.reports.figures.tracks import track_figure
from difffilter.reports.report import Report
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.verdict.grade import GRADES, IF, KEEP, Grade, Term

__all__ = ["grade_without_truth", "index_without_truth", "verdict_without_truth"]

#: Mean squares of what is hidden, in sigmas, outside which a covariance is told wrong.
FAIR = (0.5, 2.0)
#: Sigmas that a channel may stand apart from the others, shares that may be rejected, and the
#: correlation of successive innovations from which errors last.
APART, REJECTS, LASTS = 1.0, 0.2, 0.3
#: The condition of every verdict without truth.
SHARED = Term(
    "no error that all sensors share, or that lasts and that the motion follows",
    "unknown: it foretells itself, and the covariance does not count it",
    "an independent position now and then (a surveyed point, a better sensor)",
    plausible="no log without truth can exclude it",
)


def verdict_without_truth(
    report: Report, checkpoint: Checkpoint, log: Log, *, name: str = "", engine: str = "auto"
) -> str:
    """Write the sections of one checkpoint into a report; the advice.

    Args:
        log: recorded logs that nothing was tuned on; truth in them is not looked at.
        name: of the checkpoint in headings and file names; the scenario's if empty.

    Raises:
        InputError: as for :func:`difffilter.compare_without_truth`.
    """
    system = checkpoint.system
    found = compare_without_truth(
        checkpoint.scenario,
        {"published": None, "tuned": checkpoint},
        log=log,
        systems=(system,),
        engine=engine,
    )
    name = name or checkpoint.scenario.name
    heading = f"{name}, {system}"
    made = grade_without_truth(found, system)
    report.heading(heading)
    report.verdict(heading, made.text, _data(found, made, system))
    report.card(made.word, _summary(found, made, system))
    head = ["condition, or what was found", "what it costs", "monitor", "plausible"]
    rows = [[term.text, term.cost, term.monitor, term.plausible] for term in made.terms]
    report.table(f"{name} terms", head, rows)
    report.text(UNKNOWABLE)
    with report.folded("What is foretold"):
        _answers(report, found, name)
    with report.folded("Channel by channel"):
        _channels(report, found, name)
    with report.folded("What changed"):
        _changes(report, checkpoint, name)
    with report.folded("The track"):
        track = found.tracks[system, "tuned"]
        figure = track_figure(log.only(track.channels), track, title="tuned")
        report.figure(figure, f"{name}-track", "Estimates and weights with the tuned values")
    return made.text


def grade_without_truth(found: Untold, system: str) -> Grade:
    """The grade: never a plain *adopt*.

    *Adopt if* where a question other than the next row is surely answered better and none surely
    worse, or where the published covariance is told wrong and the tuned one is not; else *keep*.
    """
    before, after = found.of(system, "published"), found.of(system, "tuned")
    told = {name: a for name, a in after.items() if name != NEXT} or after
    better = [a for a in told.values() if a.gain_ci95[0] > 0.0]
    worse = [a for a in told.values() if a.gain_ci95[1] < 0.0]
    mended = all(_fair(after[n]) for n in told) and not all(_fair(before[n]) for n in told)
    terms = (SHARED, *_found(found, system, after))
    if mended and not (better and not worse):
        why = "for their covariance, as far as hidden measurements tell; " + _scores(told)
        return Grade(IF, why, terms)
    if worse:
        return Grade(KEEP, f"the tuned values foretell less; {_scores(told)}", terms)
    if not better:
        return Grade(KEEP, f"nothing that is sure is foretold better; {_scores(told)}", terms)
    return Grade(IF, f"the tuned values foretell more; {_scores(told)}", terms)


def index_without_truth(report: Report, judged: Mapping[str, Mapping[str, Any]]) -> None:
    """One table, a row per checkpoint, the best grade first; each leads to its page."""
    order = sorted(judged.items(), key=lambda item: GRADES.index(item[1]["grade"]))
    rows = [[name, data["grade"], data["why"]] for name, data in order]
    report.index(["checkpoint", "grade", "why"], rows, [data["page"] for _, data in order])


def _fair(answer: Answer) -> bool:
    return FAIR[0] <= answer.squares <= FAIR[1]


def _scores(told: Mapping[str, Answer]) -> str:
    each = (
        f"{name} {a.gain:+.3f} nats ({a.gain_ci95[0]:.3f} to {a.gain_ci95[1]:.3f})"
        for name, a in told.items()
    )
    return f"less surprise by measurement, {', '.join(each)}"


def _found(found: Untold, system: str, after: Mapping[str, Answer]) -> list[Term]:
    """What the tuned filter's own checks find."""
    terms = []
    wrong = {name: a.squares for name, a in after.items() if name != NEXT and not _fair(a)}
    if wrong:
        each = ", ".join(f"{name} {value:.2g}" for name, value in wrong.items())
        terms.append(
            Term(
                f"what is hidden misses by other than it should (mean square in sigmas: {each})",
                "the covariance is too small above 1, too large below",
                "the mean square of innovations",
            )
        )
    own = [c for c in found.channels if (c.system, c.values) == (system, "tuned")]
    for channel in own:
        terms += _of_channel(channel)
    lasting = [c.channel for c in own if abs(c.correlation) > max(LASTS, c.white)]
    if lasting:
        terms.append(
            Term(
                f"successive innovations of {', '.join(lasting)} are alike",
                "errors last, or the motion is too stiff: the covariance is too small by a "
                "factor that this log cannot tell",
                "the correlation of innovations",
            )
        )
    return terms


def _of_channel(channel: ChannelCheck) -> list[Term]:
    terms = []
    if channel.apart is not None:
        value, low, high = channel.apart
        if abs(value) > APART and low * high > 0.0:
            terms.append(
                Term(
                    f"{channel.channel} stands {value:+.2g} sigma from what the others foretell",
                    "one of them is biased; which one, the log alone cannot say",
                    "its mean distance from the others",
                )
            )
    if channel.rejected > REJECTS:
        terms.append(
            Term(
                f"{100.0 * channel.rejected:.0f} % of {channel.channel} are rejected",
                "a faulty sensor, or a filter that is sure of the wrong track",
                "its share of rejected measurements",
            )
        )
    return terms


def _summary(found: Untold, made: Grade, system: str) -> list[tuple[str, str]]:
    after = found.of(system, "tuned")
    rows = [
        (f"Foretold, {name}", f"{a.gain:+.3f} nats by measurement (95 %: {a.gain_ci95[0]:.3f} to "
         f"{a.gain_ci95[1]:.3f}); mean square {a.squares:.2f} (1 is right)")
        for name, a in after.items()
    ]  # fmt: skip
    todo = "keep the published values" if made.word == KEEP else (
        f"adopt them if the {len(made.terms)} condition{'s' * (len(made.terms) > 1)} below hold"
    )  # fmt: skip
    return [*rows, ("Cannot be known", SHARED.text), ("What to do", todo)]


def _answers(report: Report, found: Untold, name: str) -> None:
    asked = "; ".join(f"{question}: {text}" for question, text in QUESTIONS.items())
    report.text(
        f"{asked}. Windows of {found.seconds:.4g} s. Surprise: negative log density of a "
        "measurement, Student's t of four degrees; gains on the same measurements."
    )
    head, rows = found.cells()
    report.table(f"{name} foretold", head, rows)
    for question, why in found.unasked.items():
        report.text(f"Not asked, {question}: {why}.")


def _channels(report: Report, found: Untold, name: str) -> None:
    report.text(
        "Innovations in sigmas: their mean square (1 is right), the share beyond 1.96 (5 is "
        "right), the correlation of successive ones (0 is right), what the weights rejected, and "
        "the mean distance from what the other sensors foretell (0 is right)."
    )
    head, rows = found.channel_cells()
    report.table(f"{name} channels", head, rows)


def _changes(report: Report, checkpoint: Checkpoint, name: str) -> None:
    errors = checkpoint.training.get("standard_errors", {})
    rows = []
    for parameter in checkpoint.published_filter.declarations.values():
        if not parameter.tuned:
            continue
        unit, factor = parameter.shown
        pair = parameter.tensor().reshape(-1), checkpoint.values[parameter.name].reshape(-1)
        for entry, before, after in zip(parameter.entries(), *pair, strict=True):
            error = errors.get(entry)
            shown = [float(before) / factor, float(after) / factor]
            rows.append([entry, *shown, None if error is None else error / factor, unit])
    report.table(f"{name} values", ["value", "published", "tuned", "standard error", "unit"], rows)


def _data(found: Untold, made: Grade, system: str) -> dict[str, Any]:
    return {
        "grade": made.word,
        "why": made.why,
        "truth": False,
        "terms": made.as_dict()["terms"],
        "gains": {n: [a.gain, *a.gain_ci95] for n, a in found.of(system, "tuned").items()},
        "foretold": found.as_dict(),
        "page": "report.html",
    }
