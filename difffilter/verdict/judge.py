"""The verdict on a checkpoint as a report: adopt the tuned values or not, and at what risk."""

from __future__ import annotations

from collections.abc import Sequence

from difffilter.comparison.comparison import Comparison, compare
from difffilter.comparison.held_out import HeldOut
from difffilter.logs.log import Log
from difffilter.reports.figures.world import world_figure
from difffilter.reports.report import Report
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scenario.scenario import Scenario
from difffilter.scenario.simulation import simulate
from difffilter.scenario.systems import recipes
from difffilter.verdict.contest_section import write_contest
from difffilter.verdict.figures_verdict import grid_figure, stress_figure
from difffilter.verdict.sections import Case, write_changes, write_trust
from difffilter.verdict.stresses import Stressed, stress, stress_grid
from difffilter.verdict.what_changed import Change, changes, honest

__all__ = ["advice", "verdict"]

#: A condition is a risk where tuned values are this much worse than the published ones.
WORSE = 1.03


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
) -> str:
    """Write the sections of one checkpoint into a report; the advice.

    Args:
        trajectories, seed: of the simulated held-out trajectories.
        log: recorded ones in their place.
        train: recorded logs that the values were tuned on, for the contest.
        name: of the checkpoint in headings and file names; the scenario's if empty.
        seeds: of the contest of tuners, one tuning each; none leaves it out.
        progress: show how far the contest is.

    Raises:
        InputError: a scenario of recordings without ``log``; a log without truth.
    """
    scenario, system = checkpoint.scenario, checkpoint.system
    filter = checkpoint.published_filter
    held_out = simulate(scenario, trajectories, seed, "test") if log is None else log
    held = HeldOut(scenario, filter, held_out.only(filter.channels), checkpoint.temperature, engine)
    name = name or scenario.name
    case = Case(
        f"{name}, {system}", name, checkpoint, held,
        held.outcome(), held.outcome(checkpoint.values),
    )  # fmt: skip
    told = [n for n, spec in scenario.systems.items() if spec.clairvoyant and log is None]
    table = compare(
        scenario, {"published": None, "tuned": checkpoint}, trajectories, seed, log=log,
        systems=tuple(dict.fromkeys([system, *told])), engine=engine,
    )  # fmt: skip
    found = changes(checkpoint, held_out, engine=engine)
    stressed = list(
        stress(scenario, filter, held.log, checkpoint.values,
               temperature=checkpoint.temperature, engine=engine)
    )  # fmt: skip
    text = advice(table, system, found, stressed)
    report.heading(f"{case.name}: {text.partition('.')[0]}")
    report.verdict(case.name, text)
    report.text(text)
    _world(report, case)
    report.heading("Published against tuned, held out", 3)
    report.text(_data(case, held_out.trajectories, None if log is not None else seed))
    report.comparison(f"{case.slug} held out", table)
    write_changes(report, case, found)
    write_trust(report, case, seed)
    _stress(report, case, stressed)
    write_contest(report, case, train, seeds, progress)
    return text


def advice(
    table: Comparison, system: str, found: Sequence[Change], stressed: Sequence[Stressed]
) -> str:
    """What the numbers say to somebody who has to decide."""
    row, before = table.row(system, "tuned"), table.row(system, "published")
    low, high = row.ratio_ci95
    risks = [
        f"{x.condition} {x.level:g} ({100 * (x.ratio[0] - 1):+.0f} %)"
        for x in stressed if x.ratio[0] > WORSE and x.ratio[1] > 1.0
    ]  # fmt: skip
    fair = honest(row.nees_per_state)
    mended = fair and not honest(before.nees_per_state)
    care = "Adopt with care" if risks or not fair else "Adopt the tuned values"
    gain = f"RMSE {row.rmse:.3g} m, {row.ratio:.3f} of the published values' ({low:.3f}-{high:.3f})"
    if high < 1.0:
        first = f"{care}. Held out the tuned values win"
    elif mended and row.ratio <= WORSE:
        first = f"{care} for their covariance. Held out the errors are not surely smaller"
    elif low > 1.0:
        first = "Keep the published values. Held out the tuned ones lose"
    else:
        first = "Keep the published values. Held out, tuning wins nothing that is sure"
    parts = [f"{first}: {gain}"]
    nees = (
        f"NEES per state {row.nees_per_state:.2f}, published {before.nees_per_state:.3g} "
        "(1 is honest)"
    )
    if not fair:
        nees += ", so that the covariance must not be trusted"
    parts.append(nees)
    if risks:
        parts.append(f"they are worse than the published ones under {', '.join(risks)}")
    spare = [change.name for change in found if change.keep]
    if spare:
        parts.append(f"at its published value costs nothing: {', '.join(spare)}")
    return "; ".join(parts) + "."


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


def _stress(report: Report, case: Case, found: Sequence[Stressed]) -> None:
    report.heading("Beyond what it was tuned on", 3)
    caption = "Held-out RMSE under conditions that nobody tuned for"
    report.figure(stress_figure(found), f"{case.slug}-stress", caption)
    head = ["condition", "level", "published (m)", "tuned (m)", "tuned / published",
            "95 % interval", "NEES published", "NEES tuned"]  # fmt: skip
    rows = [
        [x.condition, f"{x.level:g}", x.published, x.tuned, x.ratio[0], x.ratio[1:], *x.nees]
        for x in found
    ]
    report.table(f"{case.slug} stress", head, rows)
    held = case.held
    grid = stress_grid(
        held.scenario, held.filter, held.log, case.checkpoint.values,
        temperature=held.temperature, engine=held.engine,
    )  # fmt: skip
    caption = (
        "Noise and outliers together. Colour and numbers: RMSE of tuned by that of published "
        "values, blue where tuned ones are better; contours: RMSE of the published values"
    )
    report.figure(grid_figure(grid), f"{case.slug}-grid", caption)
