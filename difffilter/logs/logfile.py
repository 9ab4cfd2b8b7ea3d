"""Log files: CSV and others, one row per time, an empty field where a channel is missing."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from difffilter.errors import InputError, LogError, shown
from difffilter.files import write_atomically
from difffilter.logs.layout import Bound, Layout
from difffilter.logs.log import Log
from difffilter.logs.reading import read_table_as_log
from difffilter.logs.sheets import read_sheet
from difffilter.logs.tables import MARK, Column, read_table, table_of
from difffilter.logs.writing import MANY, CsvParts
from difffilter.registry import NAME

__all__ = ["read_any", "read_log", "write_log"]


def read_log(
    source: str | Path | Any,
    channels: Sequence[str],
    inputs: Sequence[str] = (),
    *,
    bounds: Mapping[str, tuple[float, float]] | None = None,
    **layout: Any,
) -> Log:
    """Read one trajectory.

    Columns: ``time`` (s), every channel and input named, and optional ``truth_<state>``, in SI
    units, unless a layout says otherwise.

    Args:
        source: a file (CSV; Parquet, Feather, MAT with the extra ``logs``; npz), a pandas or
            polars frame, or a mapping of names to arrays.
        channels: names of the channels, in the filter's order; all must have a column.
        inputs: names of input columns; a value is needed in every row.
        bounds: by channel, (low, high) in SI: values must be above low and at most high.
        layout: keywords of :class:`difffilter.logs.layout.Layout`: ``columns``, ``units``,
            ``time``, ``format``, ``ignore``, ``missing``, ``sort``, ``separator`` ...

    Returns:
        Log with z (T, m). Dated times count from the first row's whole second.

    Raises:
        LogError: unreadable file, wrong or missing column, row of the wrong length, text
            in a number, a number that is not finite or out of bounds, time missing or not
            increasing; the message names file and line.
        InputError: a layout that does not fit together.

    Example:
        >>> frame = {"unix": [1.62e9, 1.62e9 + 1], "r_km": [1.2, 1.3], "note": ["", "ok"]}
        >>> log = read_log(frame, ["range"], columns={"r_km": "range"}, units={"range": "km"},
        ...                time="unix", format="unix", ignore=["note"])
        >>> log.z.tolist(), log.time.tolist()
        ([[1200.0], [1300.0]], [0.0, 1.0])
    """
    for key in {"ignore", "missing"} & set(layout):
        layout[key] = tuple(layout[key])
    form = Layout(**layout)
    limits = {
        name: Bound(low, high, f"a number above {low:g} and at most {high:g}")
        for name, (low, high) in (bounds or {}).items()
    }
    if isinstance(source, str | Path):
        path = Path(source)
        table, name = read_table(path, form.separator, form.decimal), path.stem
    else:
        table, name = table_of(source), "frame"
    return read_table_as_log(table, form, channels, inputs, limits, name=name).log


def read_any(path: str | Path) -> Log:
    """A log whose channels nobody has named: every column of numbers but time and truth.

    Raises:
        LogError: as for :func:`read_log`; no column of numbers.
    """
    table = read_table(Path(path))
    names = [n for n in table.names if n != "time" and not n.startswith("truth_")]
    channels = [n for n in names if _is_numbers(table.columns[n])]
    if wrong := [n for n in channels if not NAME.fullmatch(n)]:
        raise LogError(
            f"{path}, line 1: found column {shown(wrong[0])}, expected a name: a letter, then "
            "letters, digits, _ and -, at most 64; [log] columns of a scenario renames it"
        )
    if not channels:
        raise LogError(f"{path}, line 1: found no column of numbers, expected one beside time")
    left_out = tuple(n for n in names if n not in channels)
    form = Layout(ignore=left_out)
    sheet = read_sheet(replace(table, plain=False), form, channels, channels)
    z = torch.from_numpy(np.stack([sheet.columns[n] for n in channels], axis=-1))
    time = torch.from_numpy(np.ascontiguousarray(sheet.time))
    return Log(tuple(channels), time, z, names=(Path(path).stem,))


def _is_numbers(column: Column) -> bool:
    """Whether the first fields that say anything are numbers."""
    if not isinstance(column, list):
        return True
    try:
        return bool([float(text) for text in column[:50] if text])
    except ValueError:
        return False


def write_log(path: str | Path, log: Log, mark: str = "") -> None:
    """Write one trajectory; :func:`read_log` gives the same numbers back.

    Args:
        mark: a first line that says that names and units are the library's own, so that no
            layout is applied when it is read; none if "".

    Raises:
        InputError: a log of several trajectories (see :meth:`Log.alone`), or a place
            that cannot be written.
    """
    if log.z.dim() == 3 and log.trajectories == 1:
        log = log.alone()
    if log.z.dim() != 2 or log.time.dim() != 1:
        raise InputError(
            f"{path}: found a log of shape {list(log.z.shape)}, expected one trajectory"
        )
    columns = {"time": log.time.numpy()}
    for i, name in enumerate(log.channels):
        columns[name] = log.z[:, i].numpy()
    for name, value in log.inputs.items():
        if value.dim() == 1 and "." not in name:  # with a dot: of a sensor, or of a simulation
            columns[name] = value.numpy()
    if log.truth is not None:
        for i, name in enumerate(log.truth_states):
            columns[f"truth_{name}"] = log.truth[:, i].numpy()

    def content(file: BinaryIO) -> None:
        if mark:
            file.write(f"{MARK} {mark}\n".encode())
        parts = CsvParts(file)
        for first in range(0, max(log.steps, 1), MANY):
            parts.write({n: column[first : first + MANY] for n, column in columns.items()})

    write_atomically(path, content)
