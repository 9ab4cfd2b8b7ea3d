"""Sections of a verdict: what changed, and whether it is trustworthy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from difffilter.comparison.held_out import HeldOut, Outcome
from difffilter.reports.report import Report
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scoring.metrics import REJECTED, rejected
from difffilter.verdict.figures_verdict import autocorrelation, consistency_figure
from difffilter.verdict.nominal import Toll, clean, nominal_toll, toll
from difffilter.verdict.what_changed import Change

__all__ = ["Case", "write_changes", "write_trust"]


@dataclass(frozen=True)
class Case:
    """A checkpoint before its judges.

    Attributes:
        name, slug: for headings, for files and tables.
        checkpoint: with the tuned values.
        held: the data that decide; published, tuned: what both sets of values gave there.
    """

    name: str
    slug: str
    checkpoint: Checkpoint
    held: HeldOut
    published: Outcome
    tuned: Outcome


def write_changes(report: Report, case: Case, found: Sequence[Change]) -> None:
    """Every tuned value before and after, and each reverted alone."""
    rows = []
    for change in found:
        unit, factor = change.given or (change.unit, 1.0)
        for (entry, *numbers), sigmas in zip(change.entries, change.sigmas(), strict=True):
            given = [None if x is None else x / factor for x in numbers]
            rows.append([entry, *given, sigmas, unit])
    head = ["value", "published", "tuned", "standard error", "change in standard errors", "unit"]
    report.table(f"{case.slug} values", head, rows)
    report.text(
        "No standard error: the data do not determine the value. Reverted alone: RMSE with this "
        "one at its published value, divided by that of the tuned filter; above 1 the change "
        "is worth something."
    )
    head = ["reverted alone", "RMSE ratio", "95 % interval", "NEES per state", "costs nothing"]
    report.table(
        f"{case.slug} reverted",
        head,
        [
            [c.name, c.ratio[0], c.ratio[1:], c.nees_per_state, "may stay" if c.keep else ""]
            for c in found
        ],
    )
    for line in case.checkpoint.training.get("undetermined", ()):
        report.text(f"Not determined: {line}.")


def write_trust(report: Report, case: Case, seed: int) -> None:
    """Consistency over time, whiteness, and what is done to clean measurements."""
    tracks = {"published": case.published.track, "tuned": case.tuned.track}
    caption = (
        "NEES and NIS over time (band: the mean of a consistent filter in 95 %), and the "
        "autocorrelation of the innovations (band: white ones)"
    )
    log = case.held.log
    report.figure(consistency_figure(log, tracks), f"{case.slug}-consistency", caption)
    rows = []
    for label, track in tracks.items():
        found, band = autocorrelation(track)
        shares = [100.0 * share for share in rejected(track).values()]
        rows.append([label, *shares, found[0] if found else None, band])
    channels = case.held.filter.channels
    head = ["values", *(f"{channel} rejected (%)" for channel in channels),
            "correlation of successive innovations", "95 % of white ones within"]  # fmt: skip
    report.table(f"{case.slug} innovations", head, rows)
    _clean(report, case, seed)


def _clean(report: Report, case: Case, seed: int) -> None:
    """Weights and rejections of clean data, beside what a standard normal residual gets."""
    held = case.held
    other = clean(held, held.log.trajectories, seed)
    rows = []
    for label, values, outcome in (
        ("published", held.filter.published(), case.published),
        ("tuned", dict(case.checkpoint.values), case.tuned),
    ):
        on_clean = None if other is None else toll(other.outcome(values).track)
        tolls = (nominal_toll(held.filter, values), on_clean, toll(outcome.track))
        rows.append([label, *(x for one in tolls for x in _cells(one))])
    where = ("nominal", "clean", "held out")
    head = ["values", *(f"{what}, {w}" for w in where for what in ("mean weight", "rejected (%)"))]
    report.table(f"{case.slug} weights", head, rows)
    text = (
        f"Rejected: a weight below {REJECTED:g}. Nominal: standard normal residuals, each channel "
        "by itself; empty where channels share weights."
    )
    if other is None:
        text += " Clean: empty, nobody can take the faults out of a recording."
    else:
        error = [other.outcome(v).rmse for v in (None, case.checkpoint.values)]
        unit = f" {case.published.unit}".rstrip()
        text += (
            " Clean: the same world without faults, where the RMSE is "
            f"{error[0]:.3g}{unit} published and {error[1]:.3g}{unit} tuned."
        )
    report.text(text)


def _cells(one: Toll | None) -> tuple[float | None, float | None]:
    return (None, None) if one is None else (one.weight, 100.0 * one.rejected)
