"""A table read by its layout: named columns in SI units over time, checked row by row."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from difffilter.errors import LogError, shown
from difffilter.logs.layout import PLAIN, Bound, Layout
from difffilter.logs.tables import Column, Table
from difffilter.logs.times import BEYOND, FORMATS, TimeError, read_times

__all__ = ["Sheet", "read_sheet", "sorted_sheet"]

Array = NDArray[np.float64]
#: Texts that mean no number in any file.
NOTHING = {"", "nan", "null", "none", "na", "n/a"}


@dataclass(frozen=True)
class Sheet:
    """Columns in SI units over time.

    Attributes:
        where: file name; time: seconds from ``origin`` (a Unix time; None where undated).
        columns: by name; NaN where nothing was measured.
        lines: of each row in the file.
        told: what was done on the way, for a report.
    """

    where: str
    time: Array
    origin: float | None
    columns: Mapping[str, Array]
    lines: NDArray[np.int64]
    told: tuple[str, ...] = ()


def read_sheet(
    table: Table,
    layout: Layout,
    wanted: Sequence[str],
    needed: Sequence[str],
    bounds: Mapping[str, Bound] | None = None,
) -> Sheet:
    """Columns by the names that a filter knows.

    Args:
        wanted: names that may be among them, beside ``truth_<state>``.
        needed: names of which each must be there.
        bounds: what a column can be at all.

    Raises:
        LogError: a column that is absent, twice or that nothing reads; a field that is no
            number; a value out of bounds. It names file, line and column.
    """
    layout = replace(PLAIN, sort=layout.sort) if table.plain else layout
    origins = _found(table, layout, wanted, needed)
    if not len(table.lines):
        raise LogError(f"{table.where}: found a header alone, expected at least one row")
    try:
        time, origin = read_times(_times(table, layout), layout.format, layout.zone, None)
    except TimeError as error:
        raise _wrong_time(table, layout, error) from None
    _check_size(table, layout, time)
    columns = {}
    for name, (column, chosen) in origins.items():
        values = _numbers(table, column, layout.missing)
        values = values * layout.factor(name)
        if chosen is not None:
            values = np.where(chosen, values, np.nan)
        if bounds and name in bounds and not table.plain:
            values = _bounded(table, layout, (name, column), values, bounds[name])
        columns[name] = values
    return Sheet(table.where, time, origin, columns, table.lines)


def _found(
    table: Table, layout: Layout, wanted: Sequence[str], needed: Sequence[str]
) -> dict[str, tuple[str, NDArray[np.bool_] | None]]:
    """By name: its column, and in long form the rows that are its own."""
    head = f"{table.where}, line {2 if table.plain else 1}"
    for column in (layout.time, *((layout.by, layout.value) if layout.by else ())):
        if column not in table.columns:
            raise LogError(
                f"{head}: found columns {_list(table.names)}; expected {column!r} among them"
            )
    found: dict[str, tuple[str, NDArray[np.bool_] | None]] = {}
    rest = [name for name in table.names if name not in (layout.time, layout.by, layout.value)]
    if layout.by:
        labels = np.array([_label(value) for value in table.columns[layout.by]])
        for label in np.unique(labels):
            name = layout.name(str(label))
            if name in wanted:
                found[name] = (layout.value, labels == label)
            elif not {"*", str(label)} & set(layout.ignore):
                line = table.lines[int(np.argmax(labels == label))]
                raise LogError(
                    f"{table.where}, line {line}, column {layout.by}: found {shown(str(label))}, "
                    f"expected one of {_list(wanted)}; name it in columns, or ignore it"
                )
    unread = []
    for column in rest:
        name = layout.name(column)
        if column in layout.ignore:
            continue
        if name in found:
            raise LogError(f"{head}: found two columns for {name!r}, expected one")
        if name in wanted or name.startswith("truth_"):
            found[name] = (column, None)
        elif "*" not in layout.ignore:
            unread.append(column)
    for name in needed:
        if name not in found and not layout.by:
            raise LogError(
                f"{head}: found columns {_list(table.names)}; expected {name!r} among them"
            )
    if unread:
        plural = "columns" if len(unread) > 1 else "column"
        named = ", ".join(map(shown, unread[:20]))
        raise LogError(
            f"{head}: found {plural} {named}, expected {_list((layout.time, *wanted))} or "
            "truth_<state>; rename them in columns, or ignore them"
        )
    return found


def _list(names: Sequence[str]) -> str:
    return ", ".join(name[:64] for name in names[:30]) + (", ..." if len(names) > 30 else "")


def _label(value: object) -> str:
    """A label in long form: 105.0 of a table of numbers is 105."""
    number = isinstance(value, (float, np.floating)) and float(value).is_integer()
    return str(int(value)) if number else str(value).strip()  # type: ignore[call-overload]


def _times(table: Table, layout: Layout) -> Array | list[str]:
    column = table.columns[layout.time]
    if isinstance(column, list):
        for line, text in zip(table.lines, column, strict=True):
            if text.lower() in NOTHING:
                raise LogError(
                    f"{table.where}, line {line}, column {layout.time}: found nothing, "
                    "expected a number"
                )
        return column
    numbers = np.asarray(column)
    absent = ~np.isfinite(numbers)
    if absent.any():
        line = table.lines[int(np.argmax(absent))]
        raise LogError(
            f"{table.where}, line {line}, column {layout.time}: found nothing, expected a number"
        )
    return numbers


def _wrong_time(table: Table, layout: Layout, error: TimeError) -> LogError:
    found = table.columns[layout.time][error.row]
    line = table.lines[error.row]
    hint = ""
    if layout.format != "iso" and str(found)[4:5] == "-":
        hint = '; an ISO 8601 time is read with the time format "iso"'
    return LogError(
        f"{table.where}, line {line}, column {layout.time}: found {shown(found)}, "
        f"expected {error}{hint}"
    )


def _check_size(table: Table, layout: Layout, time: Array) -> None:
    """Seconds that would be thousands of years are milli-, micro- or nanoseconds."""
    if FORMATS[layout.format][1] or np.abs(time).max() < BEYOND:
        return
    row = int(np.argmax(np.abs(time) >= BEYOND))
    guess = next((f for f, (s, d) in FORMATS.items() if d and abs(time[row]) * s < 5e9), "")
    hint = f'; if it is a Unix time, write the time format "{guess}"' if guess else ""
    raise LogError(
        f"{table.where}, line {table.lines[row]}, column {layout.time}: found {time[row]:.17g}, "
        f"expected seconds{hint}"
    )


def _numbers(table: Table, column: str, missing: Sequence[str | float]) -> Array:
    """A column as numbers, NaN where it has none."""
    values: Column = table.columns[column]
    words = NOTHING | {text.lower() for text in missing if isinstance(text, str)}
    numbers = [float(value) for value in missing if not isinstance(value, str)]
    if isinstance(values, list):
        found = np.array([math.nan if t.lower() in words else _number(t) for t in values])
        wrong = ~np.isfinite(found) & np.array([t.lower() not in words for t in values])
    else:
        found = np.asarray(values, dtype=np.float64)
        wrong = np.isinf(found)
    if wrong.any():
        row = int(np.argmax(wrong))
        raise LogError(
            f"{table.where}, line {table.lines[row]}, column {column}: found {shown(values[row])}, "
            "expected a finite number or an empty field"
        )
    for value in numbers:
        found = np.where(found == value, np.nan, found)
    return found


def _number(text: str) -> float:
    try:
        return float(text) if text.isascii() and "_" not in text else math.inf
    except ValueError:
        return math.inf


def _bounded(
    table: Table, layout: Layout, names: tuple[str, str], values: Array, bound: Bound
) -> Array:
    """Values within what they can be; others are an error, or missing where so declared."""
    name, column = names
    outside = (values <= bound.low) | (values > bound.high)
    if not outside.any():
        return values
    if layout.beyond == "missing":
        return np.where(outside, np.nan, values)
    row = int(np.argmax(outside))
    raw = table.columns[column][row]
    degrees = "rad" in bound.expected and name not in layout.units
    hint = 'degrees are read with the unit "deg"' if degrees else "say what means missing"
    raise LogError(
        f"{table.where}, line {table.lines[row]}, column {column}: found {shown(str(raw))[1:-1]}, "
        f"expected {bound.expected} ({int(outside.sum())} such of {len(values)}); {hint}"
    )


def sorted_sheet(sheet: Sheet, layout: Layout) -> Sheet:
    """Rows in order of time, equal times combined; without ``sort`` an error where needed."""
    steps = np.diff(sheet.time)
    back, again = steps < 0, steps == 0
    if not (back.any() or again.any()):
        return sheet
    if not layout.sort:
        row = int(np.argmax(steps <= 0)) + 1
        now, before = float(sheet.time[row]), float(sheet.time[row - 1])
        whole = sheet.origin or 0.0
        by = f"by {before - now:.3g} s " if now < before else ""
        raise LogError(
            f"{sheet.where}, line {sheet.lines[row]}, column {layout.time}: "
            f"found {now + whole!r} after {before + whole!r}, expected increasing times: it runs "
            f"back {by}in {int(back.sum())} rows and stands in {int(again.sum())}; with sort = "
            "true a log is sorted and rows of equal times are combined"
        )
    told = list(sheet.told)
    if back.any():
        told.append(
            f"{sheet.where}: sorted, time ran back in {int(back.sum())} rows, "
            f"by {-steps.min():.3g} s at most"
        )
    order = np.argsort(sheet.time, kind="stable")
    time, columns = sheet.time[order], {n: c[order] for n, c in sheet.columns.items()}
    first = np.concatenate([[True], np.diff(time) > 0])
    if not first.all():
        columns, differing = _combined(columns, first)
        note = f"{sheet.where}: {int((~first).sum())} rows joined to one of the same time"
        kept = f"; in {differing} fields another value was there already: the first is kept"
        told.append(note + (kept if differing else ""))
    return replace(
        sheet, time=time[first], columns=columns, lines=sheet.lines[order][first], told=tuple(told)
    )


def _combined(
    columns: Mapping[str, Array], first: NDArray[np.bool_]
) -> tuple[dict[str, Array], int]:
    """The first number of each group of rows, and how many others differ from it."""
    group = np.cumsum(first) - 1
    found, differing = {}, 0
    for name, values in columns.items():
        present = ~np.isnan(values)
        kept = np.full(int(first.sum()), np.nan)
        at = np.flatnonzero(present)[::-1]
        kept[group[at]] = values[at]  # the last that is written is the first of its group
        differing += int((kept[group[at]] != values[at]).sum())
        found[name] = kept
    return found, differing
