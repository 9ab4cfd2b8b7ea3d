"""The verdict on a checkpoint as a report: adopt the tuned values or not, and at what risk."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from difffilter.checkpoint import Checkpoint
from difffilter.compare import Comparison, compare
from difffilter.estimate import estimate, started
from difffilter.figures.tracks import track_figure
from difffilter.figures.verdict import consistency_figure, stress_figure
from difffilter.log import Log
from difffilter.metrics import rejected
from difffilter.report import Report
from difffilter.run import Track
from difffilter.simulate import simulate
from difffilter.stress import Stressed, stress
from difffilter.verdict import Change, changes, honest

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
    engine: str = "auto",
) -> str:
    """Write the sections of one checkpoint into a report; the advice.

    Args:
        trajectories, seed: of the simulated held-out trajectories.
        log: recorded ones in their place.

    Raises:
        InputError: a scenario of recordings without ``log``; a log without truth.
    """
    scenario, system = checkpoint.scenario, checkpoint.system
    filter = checkpoint.published_filter
    held_out = simulate(scenario, trajectories, seed, "test") if log is None else log
    told = [name for name, spec in scenario.systems.items() if spec.clairvoyant and log is None]
    table = compare(
        scenario, {"published": None, "tuned": checkpoint}, trajectories, seed, log=log,
        systems=tuple(dict.fromkeys([system, *told])), engine=engine,
    )  # fmt: skip
    found = changes(checkpoint, held_out, engine=engine)
    stressed = list(
        stress(scenario, filter, held_out, checkpoint.values,
               temperature=checkpoint.temperature, engine=engine)
    )  # fmt: skip
    tracks = _tracks(checkpoint, held_out, engine)

    name = f"{scenario.name}, {system}"
    text = advice(table, system, found, stressed)
    report.heading(f"{name}: {text.partition('.')[0]}")
    report.text(text)
    report.text(f"{scenario.title}. {' '.join(scenario.notes)}")
    slug = scenario.name
    caption = "The world: one held-out trajectory, tuned values"
    report.figure(track_figure(held_out, tracks["tuned"], 0, caption), f"{slug}-world", caption)
    report.heading(f"{name}: published against tuned, held out")
    report.comparison(f"{slug} held out", table)
    _changes(report, slug, name, found, checkpoint.training.get("undetermined", ()))
    _trust(report, slug, name, held_out, tracks)
    _stress(report, slug, name, stressed)
    return text


def advice(
    table: Comparison, system: str, found: Sequence[Change], stressed: Sequence[Stressed]
) -> str:
    """What the numbers say to somebody who has to decide."""
    row = table.row(system, "tuned")
    low, high = row.ratio_ci95
    risks = [
        f"{x.condition} {x.level:g} ({100 * (x.ratio[0] - 1):+.0f} %)"
        for x in stressed if x.ratio[0] > WORSE and x.ratio[1] > 1.0
    ]  # fmt: skip
    gain = f"RMSE {row.rmse:.3g} m, {row.ratio:.3f} of the published values' ({low:.3f}-{high:.3f})"
    if high >= 1.0:
        first = "Keep the published values. Held out, tuning wins nothing that is sure"
    elif risks or not honest(row.nees_per_state):
        first = "Adopt with care. Held out the tuned values win"
    else:
        first = "Adopt the tuned values. Held out they win"
    parts = [f"{first}: {gain}"]
    nees = f"NEES per state {row.nees_per_state:.2f} (1 is honest)"
    if not honest(row.nees_per_state):
        nees += ", so that the covariance must not be trusted"
    parts.append(nees)
    if risks:
        parts.append(f"they are worse than the published ones under {', '.join(risks)}")
    spare = [change.name for change in found if change.keep]
    if spare:
        parts.append(f"at its published value costs nothing: {', '.join(spare)}")
    return "; ".join(parts) + "."


def _tracks(checkpoint: Checkpoint, log: Log, engine: str) -> dict[str, Track]:
    filter = checkpoint.published_filter
    tracks = {}
    for label, values in (("published", filter.published()), ("tuned", checkpoint.values)):
        ready = started(checkpoint.scenario, filter, log, values)
        with torch.no_grad():
            tracks[label] = estimate(
                filter, ready, values, temperature=checkpoint.temperature, engine=engine
            )
    return tracks


def _changes(
    report: Report, slug: str, name: str, found: Sequence[Change], free: Sequence[str]
) -> None:
    report.heading(f"{name}: what changed, and what each change is worth")
    rows = [
        [entry, before, after, error, sigmas, change.unit]
        for change in found
        for (entry, before, after, error), sigmas in zip(
            change.entries, change.sigmas(), strict=True
        )
    ]  # fmt: skip
    head = ["value", "published", "tuned", "standard error", "change in standard errors", "unit"]
    report.table(f"{slug} values", head, rows)
    report.text(
        "No standard error: the data do not determine the value. Reverted alone: RMSE with this "
        "one at its published value, divided by that of the tuned filter; above 1 the change "
        "is worth something."
    )
    head = ["reverted alone", "RMSE ratio", "95 % interval", "NEES per state", "costs nothing"]
    report.table(
        f"{slug} reverted",
        head,
        [
            [c.name, c.ratio[0], c.ratio[1:], c.nees_per_state, "may stay" if c.keep else ""]
            for c in found
        ],
    )
    for line in free:
        report.text(f"Not determined: {line}.")


def _trust(report: Report, slug: str, name: str, log: Log, tracks: dict[str, Track]) -> None:
    report.heading(f"{name}: is it trustworthy?")
    caption = "NEES and NIS over time; the band holds the mean of a consistent filter in 95 %"
    report.figure(consistency_figure(log, tracks), f"{slug}-consistency", caption)
    rows = [
        [label, *(100.0 * share for share in rejected(track).values()), _whiteness(track)]
        for label, track in tracks.items()
    ]
    channels = next(iter(tracks.values())).channels
    head = ["values", *(f"{channel} rejected (%)" for channel in channels),
            "correlation of successive innovations"]  # fmt: skip
    report.table(f"{slug} innovations", head, rows)


def _whiteness(track: Track) -> float:
    """Correlation of each channel's normalised innovation with the one before; 0 when white."""
    assert track.record is not None
    record = track.record
    sigma = record.innovation_variance.sqrt()
    normal = torch.where(record.present, (record.innovation / sigma).clamp(-3.0, 3.0), torch.nan)
    first, second = normal[:-1], normal[1:]
    known = torch.isfinite(first) & torch.isfinite(second)
    a, b = first[known], second[known]
    return float((a * b).mean() / (a.square().mean() * b.square().mean()).sqrt())


def _stress(report: Report, slug: str, name: str, found: Sequence[Stressed]) -> None:
    report.heading(f"{name}: beyond what it was tuned on")
    caption = "Held-out RMSE under conditions that nobody tuned for"
    report.figure(stress_figure(found), f"{slug}-stress", caption)
    head = ["condition", "level", "published (m)", "tuned (m)", "tuned / published",
            "95 % interval", "NEES published", "NEES tuned"]  # fmt: skip
    report.table(
        f"{slug} stress",
        head,
        [
            [x.condition, x.level, x.published, x.tuned, x.ratio[0], x.ratio[1:], *x.nees]
            for x in found
        ],
    )
