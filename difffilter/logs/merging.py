"""Several tables of one log, each at its own rate, as one: rows of measurements in order."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from difffilter.errors import LogError
from difffilter.logs.sheets import Sheet

__all__ = ["between", "dropped", "merged"]

Array = NDArray[np.float64]


def merged(
    sheets: Sequence[Sheet], channels: Sequence[str], angles: Sequence[str], gap: float | None
) -> Sheet:
    """One sheet: a row per time at which a channel was measured.

    What is no channel (inputs, truth) is interpolated at these times, over no more than
    ``gap`` seconds between two samples and never beyond the first and the last; else NaN.

    Args:
        sheets: sorted, one per file.
        angles: names of columns in rad, interpolated the short way round.

    Raises:
        LogError: no measurement, dated beside undated times, a column in two files.
    """
    sheets = _from_one_origin(sheets)
    measured = [s for s in sheets if set(s.columns) & set(channels)]
    if not measured:
        raise LogError(f"{sheets[0].where}: found no file with a channel of {', '.join(channels)}")
    time = np.unique(np.concatenate([_own(sheet, channels) for sheet in measured]))
    if not len(time):
        raise LogError(f"{measured[0].where}: found no measurement in any file")
    columns: dict[str, Array] = {}
    for sheet in sheets:
        at = np.searchsorted(sheet.time, time).clip(max=len(sheet.time) - 1)
        same = sheet.time[at] == time
        for name, values in sheet.columns.items():
            if name in columns:
                raise LogError(f"{sheet.where}: found {name!r}, which another file has, too")
            if name in channels:
                columns[name] = np.where(same, values[at], np.nan)
            else:
                if gap is None:
                    raise LogError(
                        f"{sheet.where}: found {name!r} in a file of its own and no gap, expected "
                        "the seconds over which it may be interpolated: [log] gap"
                    )
                columns[name] = between(sheet.time, values, time, gap, name in angles)
    told = tuple(note for sheet in sheets for note in sheet.told)
    lines = np.arange(1, len(time) + 1)
    origin = sheets[0].origin
    if origin is not None:  # seconds count from the first row's whole second
        whole = float(np.floor(time[0]))
        time, origin = time - whole, origin + whole
    return Sheet(measured[0].where, time, origin, columns, lines, told)


def _own(sheet: Sheet, channels: Sequence[str]) -> Array:
    """Times at which one of its channels was measured."""
    present = [~np.isnan(values) for name, values in sheet.columns.items() if name in channels]
    return sheet.time[np.logical_or.reduce(present)]


def _from_one_origin(sheets: Sequence[Sheet]) -> list[Sheet]:
    dated = [sheet.origin for sheet in sheets if sheet.origin is not None]
    if not dated:
        return list(sheets)
    if len(dated) < len(sheets):
        other = next(sheet.where for sheet in sheets if sheet.origin is None)
        raise LogError(f"{other}: found undated times beside dated ones, expected all alike")
    origin = min(dated)
    return [
        replace(sheet, time=sheet.time + ((sheet.origin or 0.0) - origin), origin=origin)
        for sheet in sheets
    ]


def between(time: Array, values: Array, at: Array, gap: float, angle: bool = False) -> Array:
    """Values at other times, linear between two samples no further apart than ``gap``.

    Exact at a sample; NaN across a longer gap, before the first and after the last one.
    """
    present = ~np.isnan(values)
    time, values = time[present], values[present]
    if not len(time):
        return np.full(len(at), np.nan)
    values = np.unwrap(values) if angle else values
    after = np.searchsorted(time, at).clip(0, len(time) - 1)
    before = (after - 1).clip(0)
    apart = time[after] - time[before]
    share = np.where(apart > 0, (at - time[before]) / np.where(apart > 0, apart, 1.0), 0.0)
    found = values[before] + share * (values[after] - values[before])
    inside = (apart <= gap) & (at >= time[0]) & (at <= time[-1])
    return np.where(time[after] == at, values[after], np.where(inside, found, np.nan))


def dropped(sheet: Sheet, needed: Sequence[str]) -> Sheet:
    """The rows in which every needed column has a number; what is left out is told."""
    absent: Mapping[str, NDArray[np.bool_]] = {n: np.isnan(sheet.columns[n]) for n in needed}
    keep = ~np.logical_or.reduce([*absent.values(), np.zeros(len(sheet.time), bool)])
    if keep.all():
        return sheet
    if not keep.any():
        raise LogError(f"{sheet.where}: found no row with all of {', '.join(needed)}")
    why = ", ".join(f"{name} in {int(gone.sum())}" for name, gone in absent.items() if gone.any())
    note = f"{sheet.where}: {int((~keep).sum())} rows left out, without {why}"
    return replace(
        sheet,
        time=sheet.time[keep],
        columns={name: values[keep] for name, values in sheet.columns.items()},
        lines=sheet.lines[keep],
        told=(*sheet.told, note),
    )
