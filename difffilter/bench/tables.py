"""The benchmark's report: tables, and which claims hold."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from difffilter.bench.claims import claims
from difffilter.bench.findings import AIRPORT, KINDS, Findings
from difffilter.bench.measure import AGREEMENT
from difffilter.bench.sizes import Sizes
from difffilter.reports.report import Report

__all__ = ["write"]

QUICK = "**A quick run: too small for most claims; it shows that everything works.**"


def write(
    folder: Path, found: Findings, sizes: Sizes, machine: Mapping[str, Any], quick: bool
) -> Path:
    """report.md and report.json; returns the first."""
    settings = {
        "quick": quick,
        "repetitions": sizes.repetitions,
        "seconds per job": sizes.seconds,
        "machine": machine,
    }
    report = Report(folder, "Benchmark", settings)
    if quick:
        report.text(QUICK)
    report.table("machine", ["what", "found"], [[k, _told(v)] for k, v in machine.items()])
    _speeds(report, found, sizes)
    _memory(report, found, sizes)
    _streaming(report, found)
    _compiled(report, found, sizes)
    _tuning(report, found, sizes)
    unmeasured = []
    for claim in claims(found, sizes):
        if claim.held is None:
            unmeasured.append(claim.text)
        else:
            report.claim(claim.text, claim.held, claim.got)
    if unmeasured:
        report.text("Not decided by this run: " + "; ".join(unmeasured) + ".")
    return report.write()


def _told(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {number}" for name, number in value.items()) or "none"
    return str(value)


def _speeds(report: Report, found: Findings, sizes: Sizes) -> None:
    report.heading("Speed")
    report.text(
        "The loss `position` of a TDOA filter with 7 channels and 4 states over B trajectories "
        "of T steps, float64: its value, and value and gradient towards the tuned numbers "
        "(3; 2 without weights; 4 for the M-EKF). us per filter step and trajectory; medians of "
        f"at most {sizes.repetitions} interleaved repetitions. Times faster: the best of the other "
        "libraries over this one; a peer's own is over the best of all others. Empty: no "
        "gradient, no other, or a size at which it would take minutes. All losses and gradients "
        f"agreed to {AGREEMENT:g} before anything was timed."
    )
    head = ["filter", "T", "B", "contender"]
    for kind in ("value", "value + gradient"):
        head += [f"{kind} (us)", f"{kind}: times faster"]
    rows = []
    for one in found.speeds:
        row: list[Any] = [one.filter, one.steps, one.batch, one.contender]
        for kind in KINDS:
            time, best = getattr(one, kind), found.best_other(one, kind)
            row += [time, None if time is None or best is None else best / time]
        rows.append(row)
    report.table("speed", head, rows)


def _memory(report: Report, found: Findings, sizes: Sizes) -> None:
    short, long, batch = sizes.memory
    report.heading("Peak memory of value and gradient")
    report.text(
        f"MiB beyond inputs and what the process held before, B = {batch}, each in a process of "
        "its own, compiled before. Empty: took longer than a minute."
    )
    head = ["contender", "filter", f"T = {short} (MiB)", f"T = {long} (MiB)"]
    report.table("memory", head, [[*key, *pair] for key, pair in found.memory.items()])


def _streaming(report: Report, found: Findings) -> None:
    report.heading("One step on a live stream, from Python")
    report.text(
        "`Tracker.step`; the same with `Tracker.belief` read after it; a row of `Tracker.feed`; "
        "filterpy: `predict` and `update`. Medians over runs of 200 rows."
    )
    rows = [[*key, time] for key, time in found.streaming.items()]
    report.table("streaming", ["contender", "filter", "us per step"], rows)


def _compiled(report: Report, found: Findings, sizes: Sizes) -> None:
    report.heading("First use of a filter")
    report.text(
        "Seconds in a new process. First gradient: trace, write and compile with an empty cache; "
        "cached: trace and write alone. Value: the same for the value alone, after it. Cached "
        "start: from torch imported to the first value and gradient."
    )
    head = ["filter", "import torch", "first gradient", "first value"]
    head += ["cached gradient", "cached value", "cached start"]
    rows: list[list[Any]] = []
    for name, (cold, warm) in found.compiled.items():
        late = f"> {sizes.patience:g}"
        row: list[Any] = [name, cold and cold["importing torch"]]
        row += [cold["gradient"], cold["value"]] if cold else [late, None]
        start = warm and warm["library and filter"] + warm["gradient"]
        rows.append([*row, warm and warm["gradient"], warm and warm["value"], start])
    report.table("compile", head, rows)


def _tuning(report: Report, found: Findings, sizes: Sizes) -> None:
    if sizes.tuning is None:
        return
    report.heading("A whole tuning")
    head = ["scenario", "trajectories", "s", "loss published", "loss tuned"]
    row = found.tuning or {}
    cells = [row.get(name) for name in head[2:]]
    report.text("Warm cache, simulation and held-out comparison included.")
    report.table("tuning", head, [[AIRPORT, sizes.tuning["trajectories"], *cells]])
