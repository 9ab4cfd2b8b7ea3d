"""Sections of a verdict: held out beside filters that are told, and what a guarantee costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from difffilter.comparison.comparison import TOLD, Contestant, run_all
from difffilter.comparison.table import Row, tabulate
from difffilter.errors import InputError
from difffilter.reports.report import Report
from difffilter.scenario.estimation import started
from difffilter.tuning.told import told_tuned
from difffilter.verdict.changed_logs import FAULTS
from difffilter.verdict.evidence import Evidence
from difffilter.verdict.guarantee import SETS, guarantee
from difffilter.verdict.sections import Case

__all__ = ["write_guarantee", "write_held_out"]


def write_held_out(report: Report, case: Case, found: Evidence, bound: bool) -> dict[str, Any]:
    """The table of held-out figures, and those of filters that are told of every fault.

    Args:
        bound: tune those by the same loss on the same data.

    Returns:
        RMSE and ratio to published of ``told, published`` and ``told, tuned``, where there are.
    """
    system = case.checkpoint.system
    named = [replace(row, system=system) for row in found.table.rows]
    told = _told(case, found, bound)
    if told:
        text = "Told of every fault: not to deploy."
        if bound:
            text += (
                " Tuned by the same loss on the same data it is the bound: what is left to win "
                "lies between it and the tuned values."
            )
        else:
            text += (
                " With the published noise it is no bound, tuned noise may do better; --bound "
                "tunes it, too."
            )
        report.text(text)
    rows = (*named, *told)
    table = replace(found.table, rows=rows, reference=f"{system} published")
    report.comparison(f"{case.slug} held out", table)
    return {
        f"{row.system}, {row.values}": {
            "rmse": row.rmse, "ratio": row.ratio, "ratio_ci95": list(row.ratio_ci95)
        }
        for row in told
    }  # fmt: skip


def _told(case: Case, found: Evidence, bound: bool) -> list[Row]:
    """Rows of the systems that are told, on the held-out log of the others."""
    scenario, log = case.held.scenario, case.held.log
    names = [
        n for n, s in scenario.systems.items() if s.clairvoyant and n != case.checkpoint.system
    ]
    if not names or not set(FAULTS) <= set(log.inputs):  # recorded: nobody is told
        return []
    who = [Contestant(name, "published", scenario.system(name)) for name in names]
    if bound:
        seed = int(case.checkpoint.training.get("seed") or 0)
        tuned = told_tuned(case.checkpoint.scenario, seed, case.held.engine)
        who += [
            Contestant(name, "tuned", scenario.system(name), tuned[name].values)
            for name in names
            if name in tuned
        ]
    tracks = run_all(who, log, partial(started, scenario), case.held.chosen)
    told = {
        (TOLD if len(names) == 1 else f"{TOLD}: {name}", values): track
        for (name, values), track in tracks.items()
    }
    table = tabulate(
        scenario.name, {("", "published"): found.published.track, **told}, log,
        wanted=("", "published"), score=scenario.score, scenes=scenario.scenes,
    )  # fmt: skip
    return list(table.rows[1:])


def write_guarantee(report: Report, case: Case, trajectories: int, seed: int) -> Mapping[str, Any]:
    """Values tuned on one world, on the family, and on it with guards, in every member.

    Args:
        trajectories: held out, of each member; 0 where nobody asked.

    Returns:
        The figures, by set and member; empty where there is no simulated family.
    """
    if not trajectories:
        report.text("Left out: it was not asked for (--guarantee).")
        return {}
    checkpoint = replace(case.checkpoint, scenario=case.held.scenario)
    try:
        found = guarantee(checkpoint, trajectories, seed, engine=case.held.chosen)
    except InputError as error:
        report.text(f"Left out: {error}.")
        return {}
    head = ["member", "role", "allowed"]
    for label in SETS:
        head += [label, f"95 % interval, {label}"]
    rows = []
    for member in found.worlds.family:
        cells: list[Any] = [member.name, member.role, member.allow]
        for label in SETS:
            row = found.row(member.name, label)
            cells += [row.ratio, list(row.ratio_ci95)]
        rows.append(cells)
    report.text(
        "RMSE relative to the published values', held out. A guarantee costs what the own world "
        "(base) gains less with guards; without one, what others lose."
    )
    report.table(f"{case.slug} guarantee", head, rows)
    return found.as_dict()
