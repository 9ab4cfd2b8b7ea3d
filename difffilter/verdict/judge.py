"""The verdict on a checkpoint as a page: adopt the tuned values or not, and at what risk."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from difffilter.comparison.table import labelled
from difffilter.logs.log import Log
from difffilter.reports.figures.world import world_figure
from difffilter.reports.report import Report
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scenario.scenario import Scenario
from difffilter.scenario.systems import recipes
from difffilter.verdict.bounds import write_guarantee, write_held_out
from difffilter.verdict.contest_section import write_contest
from difffilter.verdict.evidence import Evidence, gather
from difffilter.verdict.grade import GRADES, harmful, misled
from difffilter.verdict.sections import Case, write_changes, write_trust
from difffilter.verdict.stresses import Stressed
from difffilter.verdict.what_changed import changes

__all__ = ["summary", "verdict", "write_index"]


def verdict(
    report: Report,
    checkpoint: Checkpoint,
    trajectories: int = 200,
    seed: int = 1,
    *,
    log: Log | None = None,
    train: Log | None = None,
    name: str = "",
    seeds: Sequence[int] = (),
    progress: bool = False,
    engine: str = "auto",
    bound: bool = False,
    guaranteed: bool = False,
) -> str:
    """Write the sections of one checkpoint into a report; the advice.

    Args:
        trajectories, seed: of the simulated held-out trajectories.
        log: recorded ones in their place.
        train: recorded logs that the values were tuned on.
        name: of the checkpoint in headings and file names; the scenario's if empty.
        seeds: of the contest of tuners, one tuning each; none leaves it out.
        progress: show how far the contest is.
        bound: tune the filters that are told of every fault, too.
        guaranteed: tune on one world, on the family, and on it with guards, and compare.

    Raises:
        InputError: a scenario of recordings without ``log``; a log without truth.
    """
    found = gather(checkpoint, trajectories, seed, log=log, train=train, engine=engine)
    name = name or checkpoint.scenario.name
    case = Case(
        f"{name}, {checkpoint.system}", name, checkpoint, found.held, found.published, found.tuned
    )
    worth = changes(checkpoint, found.held.log, engine=found.held.chosen, tuned=found.tuned)
    made = replace(found.grade, spare=tuple(change.name for change in worth if change.keep))
    found = replace(found, grade=made)
    report.heading(case.name)
    report.card(made.word, summary(found))
    if made.terms:
        _terms(report, case, found)
    with report.folded("Held out"):
        report.text(_data(case, found.held.log.trajectories, None if log is not None else seed))
        told = write_held_out(report, case, found, bound)
        _world(report, case)
    with report.folded("Consistency by direction, and conditions that nobody tuned on"):
        _directions(report, case, found)
        _stress(report, case, found.stressed)
    with report.folded("What changed, and what each change is worth"):
        write_changes(report, case, worth)
    with report.folded("Is it trustworthy?"):
        write_trust(report, case, seed)
    with report.folded("What a guarantee costs"):
        costs = write_guarantee(report, case, trajectories if guaranteed else 0, seed)
    with report.folded("Is the gradient worth it?"):
        write_contest(report, case, train, seeds, progress)
    data = found.as_dict() | {"told": told, "guarantee": costs, "page": "report.html"}
    report.verdict(case.name, made.text, data)
    return made.text


def summary(found: Evidence) -> list[tuple[str, str]]:
    """The first screen: gain, consistency by direction, worst condition, what to do."""
    after = found.table.rows[1]
    error = [f"{_short(row.rmse, 3)} {found.table.unit}".rstrip() for row in found.table.rows]
    low, high = after.ratio_ci95
    rows = [
        ("RMSE held out", f"{error[0]} published, {error[1]} tuned: "
         f"ratio {after.ratio:.3f} (95 %: {low:.3f} to {high:.3f})"),
        ("NEES by direction", _listed(found.tuned.directions) + " (1 is right; published "
         + _listed(found.published.directions, names=False) + ")"),
    ]  # fmt: skip
    tried = [one for one in found.stressed if one.decisive]
    if tried:
        worst = max(tried, key=lambda one: one.ratio[0])
        ratio, low, high = worst.ratio
        text = f"{worst.text}: ratio {ratio:.3g} ({low:.3g} to {high:.3g}); {worst.plausible}"
        rows.append(("Worst condition", text))
    rows.append(("What to do", _todo(found)))
    return rows


def write_index(report: Report, judged: Mapping[str, Mapping[str, Any]]) -> None:
    """One table, a row per checkpoint, the best grade first; each leads to its page."""
    order = sorted(
        judged.items(), key=lambda item: (GRADES.index(item[1]["grade"]), item[1]["ratio"])
    )
    head = ["checkpoint", "grade", "RMSE ratio", "95 % interval", "NEES by direction",
            "worst condition", "its ratio"]  # fmt: skip
    rows = []
    for name, data in order:
        tried = [one for one in data["conditions"] if one["decisive"]]
        worst = max(tried, key=lambda one: one["ratio"][0], default=None)
        low, high = data["ratio_ci95"]
        nees = data["nees_by_direction"]["tuned"].values()
        rows.append([
            name, data["grade"], _short(data["ratio"], 3), f"{low:.3f} to {high:.3f}",
            ", ".join(_short(value, 2) for value in nees),
            worst["name"] if worst else "", _short(worst["ratio"][0], 3) if worst else "",
        ])  # fmt: skip
    report.index(head, rows, [data["page"] for _, data in order])


def _short(value: float, count: int) -> str:
    return f"{value:.{count}g}"


def _todo(found: Evidence) -> str:
    made = found.grade
    if made.word == "adopt":
        return "adopt the tuned values"
    if made.word == "keep":
        return f"keep the published values: {made.why.partition(';')[0]}"
    keep = sorted({name for term in made.terms for name in term.keep})
    told = f"adopt them if the {len(made.terms)} conditions below hold"
    return told + (f", or keep {', '.join(keep)} as published and tune the rest" if keep else "")


def _terms(report: Report, case: Case, found: Evidence) -> None:
    head = ["condition, or what was found", "what it costs", "monitor", "keep as published",
            "plausible"]  # fmt: skip
    rows = [
        [term.text, term.cost, term.monitor, ", ".join(term.keep), term.plausible]
        for term in found.grade.terms
    ]
    report.table(f"{case.slug} terms", head, rows)


def _listed(found: Mapping[str, float], names: bool = True) -> str:
    return ", ".join(
        f"{name} {_short(value, 2)}" if names else _short(value, 2) for name, value in found.items()
    )


def _world(report: Report, case: Case) -> None:
    scenario = case.checkpoint.scenario
    report.text(f"{scenario.title}. {' '.join(scenario.notes)}")
    shown = min(case.held.log.trajectories, 12)
    caption = (
        f"The world: {shown} held-out true path{'s' if shown > 1 else ''}, and the errors of the "
        "first one's measurements in published sigmas"
    )
    figure = world_figure(case.held.filter, case.held.log)
    report.figure(figure, f"{case.slug}-world", caption)
    if isinstance(scenario, Scenario):
        said = recipes(scenario.document["systems"])
    else:
        said = {name: system.note or "made in Python" for name, system in scenario.systems.items()}
    rows = list(said.items())
    report.table(f"{case.slug} systems", ["system", "what it is"], rows)


def _data(case: Case, count: int, seed: int | None) -> str:
    which = "recorded" if seed is None else f"simulated, seed {seed}"
    few = " Intervals come from blocks of rows." if count < 20 else ""
    return (
        f"{count} trajector{'y' if count == 1 else 'ies'} that nothing was tuned on ({which}); "
        f"frozen hard form; paired 95 % intervals.{few}"
    )


def _directions(report: Report, case: Case, found: Evidence) -> None:
    rows = [
        [name, found.published.directions.get(name), value]
        for name, value in found.tuned.directions.items()
    ]
    report.text("NEES along the principal directions of P: 1 where errors are as large as claimed.")
    report.table(f"{case.slug} directions", ["direction", "published", "tuned"], rows)


def _stress(report: Report, case: Case, found: Sequence[Stressed]) -> None:
    errors = [labelled(name, case.published.unit) for name in ("published", "tuned")]
    head = ["condition", "plausible", *errors, "tuned / published",
            "95 % interval", "NEES published", "NEES tuned", "largest NEES along a direction",
            "counts"]  # fmt: skip
    rows = [
        [
            x.text, x.plausible, x.published, x.tuned, x.ratio[0], x.ratio[1:], *x.nees,
            max((after for _, after in x.directions.values()), default=None),
            _counts(x),
        ]
        for x in found
    ]  # fmt: skip
    report.table(f"{case.slug} conditions", head, rows)


def _counts(one: Stressed) -> str:
    if not one.decisive:
        return "shown only"
    if not harmful(one):
        return ""
    return "misleads" if misled(one) and one.ratio[1] <= 1.1 else "worse"
