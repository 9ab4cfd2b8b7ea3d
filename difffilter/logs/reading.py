"""From files to a log: one table or several, read by their layouts, sorted and joined."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from difffilter.errors import InputError, LogError, shown
from difffilter.logs.layout import Bound, Form, Layout
from difffilter.logs.log import Log
from difffilter.logs.merging import dropped, merged
from difffilter.logs.sheets import Sheet, read_sheet, sorted_sheet
from difffilter.logs.tables import Table, read_table
from difffilter.logs.times import Clock
from difffilter.registry import NAME

__all__ = ["Reading", "read_table_as_log", "reading"]


@dataclass(frozen=True)
class Reading:
    """A log as read.

    Attributes:
        log: one trajectory; clock: how its times are written.
        told: what was sorted, joined and left out, a line each.
        sure: what has the unit that it should have, because somebody said so: channels, and
            ``time``.
    """

    log: Log
    clock: Clock
    told: tuple[str, ...]
    sure: frozenset[str] = frozenset()


def reading(
    path: Path,
    form: Form,
    channels: Sequence[str],
    inputs: Sequence[str] = (),
    bounds: Mapping[str, Bound] | None = None,
    optional: Sequence[str] = (),
) -> Reading:
    """Read one log.

    Args:
        path: a file; or, where the form has sources, what takes the place of ``{run}``.
        channels, inputs: names, in the order of the log.
        bounds: what a channel can be at all.
        optional: channels that may have no column.

    Raises:
        LogError: names file, line and column.
    """
    if not form.sources or path.is_file():
        layout = form.layout
        table = read_table(path, layout.separator, layout.decimal)
        single = read_table_as_log(
            table, layout, channels, inputs, bounds, optional=optional, name=path.stem
        )
        if table.plain:
            return replace(single, sure=frozenset((*channels, "time")))
        return replace(_span(single, form), sure=form.sure)
    sheets = []
    for source in form.sources:
        place = path.parent / source.file.replace("{run}", path.name)
        layout = source.layout
        table = read_table(place, layout.separator, layout.decimal)
        sheet = read_sheet(table, layout, (*channels, *inputs), (), bounds)
        sheets.append(sorted_sheet(sheet, layout))
    angles = [n for s in form.sources for n, unit in s.layout.units.items() if unit in ANGLES]
    sheet = merged(sheets, channels, angles, form.gap)
    for name in (*channels, *inputs):
        if name not in sheet.columns and name not in optional:
            files = ", ".join(source.file for source in form.sources)
            raise LogError(f"{path}: found no {name!r} in any of {files}")
    sheet = dropped(sheet, [name for name in inputs if name in sheet.columns])
    relative = {c: i for s in form.sources for c, i in s.layout.relative.items()}
    joined = _log(sheet, relative, channels, inputs, form.sources[0].layout, path.name)
    return replace(_span(joined, form), sure=form.sure)


def _span(read: Reading, form: Form) -> Reading:
    """The rows between the form's first and last second, from the first row on."""
    if form.first == 0.0 and form.last == math.inf:
        return read
    since = read.log.time - read.log.time[0]
    keep = torch.nonzero((since >= form.first) & (since < form.last)).flatten()
    where = read.log.names[0]
    if not len(keep):
        raise LogError(
            f"{where}: found no row from {form.first:g} to {form.last:g} s after the first, "
            f"expected from and until within its {float(since[-1]):.6g} s"
        )
    kept = read.log.rows(int(keep[0]), int(keep[-1]) + 1)
    note = f"{where}: {kept.steps} of {read.log.steps} rows, from {form.first:g} s"
    note += f" until {form.last:g} s" if form.last < math.inf else ""
    return replace(read, log=kept, told=(*read.told, note))


ANGLES = ("rad", "mrad", "deg")


def read_table_as_log(
    table: Table,
    layout: Layout,
    channels: Sequence[str],
    inputs: Sequence[str],
    bounds: Mapping[str, Bound] | None = None,
    optional: Sequence[str] = (),
    name: str = "",
) -> Reading:
    """One table as a log; arguments and errors as those of :func:`reading`."""
    layout = Layout(sort=layout.sort) if table.plain else layout
    needed = [n for n in (*channels, *inputs) if n not in optional]
    sheet = read_sheet(table, layout, (*channels, *inputs), needed, bounds)
    for n in inputs:
        absent = np.isnan(sheet.columns[n])
        if absent.any():
            line = sheet.lines[int(np.argmax(absent))]
            raise LogError(
                f"{table.where}, line {line}, column {n}: found nothing, expected a number"
            )
    sheet = sorted_sheet(sheet, layout)
    return _log(sheet, layout.relative, channels, inputs, layout, name)


def _log(
    sheet: Sheet,
    relative: Mapping[str, str],
    channels: Sequence[str],
    inputs: Sequence[str],
    layout: Layout,
    name: str,
) -> Reading:
    columns = dict(sheet.columns)
    for channel, base in relative.items():
        if channel not in columns or base not in columns:
            raise InputError(
                f"{sheet.where}: relative: found {channel} and {base}, expected a channel and an "
                f"input of {', '.join(columns)}"
            )
        columns[channel] = columns[channel] + columns[base]
    truth = _truth(columns, sheet.where)

    def stacked(names: Sequence[str]) -> torch.Tensor:
        return torch.from_numpy(np.stack([columns[n] for n in names], axis=-1))

    present = [n for n in channels if n in columns]
    log = Log(
        channels=tuple(present),
        time=torch.from_numpy(np.ascontiguousarray(sheet.time)),
        z=stacked(present),
        truth=stacked([f"truth_{n}" for n in truth]) if truth else None,
        truth_states=truth,
        inputs={n: torch.from_numpy(np.ascontiguousarray(columns[n])) for n in inputs},
        names=(name,),
    )
    return Reading(log, Clock(layout.format, sheet.origin), sheet.told)


def _truth(columns: Mapping[str, object], where: str) -> tuple[str, ...]:
    """Names of the true states that a file has; they are names, since others print them."""
    found = tuple(n.removeprefix("truth_") for n in columns if n.startswith("truth_"))
    for name in found:
        if not all(NAME.fullmatch(part) for part in name.split(".")):
            raise LogError(
                f"{where}: found column {shown(f'truth_{name}')}, expected truth_ and the name of "
                "a state: a letter, then letters, digits, _ and -, at most 64"
            )
    return found
