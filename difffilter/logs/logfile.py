"""Log files: CSV, one row per time, an empty field where a channel is missing."""

from __future__ import annotations

import csv
import math
from collections.abc import Sequence
from pathlib import Path

import torch

from difffilter.errors import InputError, LogError, shown
from difffilter.files import write_atomically
from difffilter.logs.log import Log

__all__ = ["read_log", "write_log"]


def read_log(path: str | Path, channels: Sequence[str], inputs: Sequence[str] = ()) -> Log:
    """Read one trajectory.

    Columns: ``time`` (s), every channel and input named, and optional ``truth_<state>``.

    Args:
        path: the CSV file.
        channels: names of the channels, in the filter's order; all must have a column.
        inputs: names of input columns; a value is needed in every row.

    Raises:
        LogError: unreadable file, wrong or missing column, row of the wrong length, text
            in a number, a number that is not finite, time missing or not increasing; the
            message names file and line.
    """
    path = Path(path)
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise LogError(f"{path}: cannot be read as CSV: {error}") from None
    if not rows:
        raise LogError(f"{path}: found an empty file, expected a header line")
    header = [name.strip() for name in rows[0]]
    truth = tuple(n.removeprefix("truth_") for n in header if n.startswith("truth_"))
    _check_header(path, header, channels, inputs)
    table = []
    for line, row in enumerate(rows[1:], start=2):
        if not row:
            continue  # the blank line that many tools leave at the end
        if len(row) != len(header):
            raise LogError(f"{path}, line {line}: found {len(row)} fields, expected {len(header)}")
        table.append([_number(path, line, n, v) for n, v in zip(header, row, strict=True)])
        _check_row(path, line, header, table, inputs)
    if not table:
        raise LogError(f"{path}: found a header alone, expected at least one row")
    data = torch.tensor(table, dtype=torch.float64)

    def column(name: str) -> int:
        return header.index(name)

    return Log(
        channels=tuple(channels),
        time=data[:, column("time")],
        z=data[:, [column(name) for name in channels]],
        truth=data[:, [column(f"truth_{name}") for name in truth]] if truth else None,
        truth_states=truth,
        inputs={name: data[:, column(name)] for name in inputs},
        names=(path.stem,),
    )


def write_log(path: str | Path, log: Log) -> None:
    """Write one trajectory; :func:`read_log` gives the same numbers back.

    Raises:
        InputError: a batched log (see :meth:`Log.select`), or a place that cannot be written.
    """
    if log.z.dim() != 2 or log.time.dim() != 1:
        raise InputError(
            f"{path}: found a log of shape {list(log.z.shape)}, expected one trajectory"
        )
    columns: dict[str, list[float]] = {"time": log.time.tolist()}
    for i, name in enumerate(log.channels):
        columns[name] = log.z[:, i].tolist()
    for name, value in log.inputs.items():
        if value.dim() == 1 and "." not in name:  # with a dot: of a sensor, or of a simulation
            columns[name] = value.tolist()
    if log.truth is not None:
        for i, name in enumerate(log.truth_states):
            columns[f"truth_{name}"] = log.truth[:, i].tolist()
    lines = [",".join(columns)]
    for row in zip(*columns.values(), strict=True):
        lines.append(",".join("" if math.isnan(value) else repr(value) for value in row))
    write_atomically(path, "\n".join(lines) + "\n")


def _check_header(
    path: Path, header: list[str], channels: Sequence[str], inputs: Sequence[str]
) -> None:
    repeated = {name for name in header if header.count(name) > 1}
    if repeated:
        raise LogError(f"{path}, line 1: found column {min(repeated)!r} twice, expected once")
    needed = ("time", *channels, *inputs)
    for name in needed:
        if name not in header:
            raise LogError(
                f"{path}, line 1: found columns {', '.join(header)}; expected {name!r} among them"
            )
    for name in header:
        if name not in needed and not name.startswith("truth_"):
            raise LogError(
                f"{path}, line 1: found column {name!r}, expected {', '.join(needed)} "
                "or truth_<state>"
            )


def _number(path: Path, line: int, name: str, text: str) -> float:
    text = text.strip()
    if not text:
        return math.nan
    try:
        value = float(text) if text.isascii() and "_" not in text else math.nan
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise LogError(
            f"{path}, line {line}, column {name}: found {shown(text)}, "
            "expected a finite number or an empty field"
        )
    return value


def _check_row(
    path: Path, line: int, header: list[str], table: list[list[float]], inputs: Sequence[str]
) -> None:
    row = dict(zip(header, table[-1], strict=True))
    for name in ("time", *inputs):
        if math.isnan(row[name]):
            raise LogError(f"{path}, line {line}, column {name}: found nothing, expected a number")
    if len(table) > 1:
        before = table[-2][header.index("time")]
        if row["time"] <= before:
            raise LogError(
                f"{path}, line {line}, column time: found {row['time']:g} after {before:g}, "
                "expected increasing times"
            )
