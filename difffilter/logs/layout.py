"""What the columns of a file of measurements are: names, units, times, what is missing."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from zoneinfo import ZoneInfo, ZoneInfoNotFoundError

from difffilter.errors import InputError, shown
from difffilter.logs.times import FORMATS
from difffilter.logs.units import factor

__all__ = ["PLAIN", "Bound", "Form", "Layout", "Source"]


@dataclass(frozen=True)
class Bound:
    """What a channel can be at all, in SI: above ``low`` and at most ``high``.

    Attributes:
        expected: in words, for messages.
    """

    low: float
    high: float
    expected: str


@dataclass(frozen=True, kw_only=True)
class Layout:
    """How one table of measurements is to be read; the defaults are a plain log.

    Attributes:
        columns: name here by the name in the table. A column without an entry keeps its name.
        units: unit by the name here (see :data:`difffilter.logs.units.UNITS`); SI without.
        time: the column of times; format: one of :data:`difffilter.logs.times.FORMATS`:
            seconds (or ms, us, ns) from no date, Unix times, or ISO 8601.
        zone: of ISO times that name none, as ``Europe/Oslo``; UTC if "".
        ignore: columns to leave out; ``*`` for all that nothing asks for.
        missing: texts and numbers that mean no measurement, beside an empty field and NaN.
        beyond: ``error``, or ``missing``: what becomes of a value that its channel cannot have.
        sort: whether rows may come in any order, and several at one time.
        separator, decimal: of the fields, and of numbers.
        by, value: of a table in long form, where each row has one measurement: the column
            that names its channel (``columns`` maps what it says), and that of the number.
        relative: input by channel, added to it: a position measured from a platform.
    """

    columns: Mapping[str, str] = field(default_factory=dict)
    units: Mapping[str, str] = field(default_factory=dict)
    time: str = "time"
    format: str = "s"
    zone: str = ""
    ignore: tuple[str, ...] = ()
    missing: tuple[str | float, ...] = ()
    beyond: str = "error"
    sort: bool = False
    separator: str = ","
    decimal: str = "."
    by: str = ""
    value: str = ""
    relative: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.format not in FORMATS:
            expected = ", ".join(FORMATS)
            raise InputError(f"log: time format: found {shown(self.format)}, expected {expected}")
        if self.beyond not in ("error", "missing"):
            raise InputError(f"log: beyond: found {shown(self.beyond)}, expected error or missing")
        if len(self.separator) != 1 or self.decimal not in (".", ",") or (
            self.separator == self.decimal
        ):  # fmt: skip
            raise InputError(
                f"log: found separator {shown(self.separator)} and decimal {shown(self.decimal)}, "
                "expected one character, and another one of . and ,"
            )
        if bool(self.by) != bool(self.value):
            raise InputError("log: found one of by and value, expected both or none")
        for name, unit in self.units.items():
            factor(unit, f"log: units.{name}")
        try:
            ZoneInfo(self.zone or "UTC")
        except (ZoneInfoNotFoundError, ValueError, OSError):
            raise InputError(
                f"log: zone: found {shown(self.zone)}, expected one as Europe/Oslo"
            ) from None

    def name(self, column: str) -> str:
        """The name here of a column."""
        return self.columns.get(column, column)

    def factor(self, name: str) -> float:
        """Factor of a column, by its name here, to SI."""
        return factor(self.units[name], f"log: units.{name}") if name in self.units else 1.0


@dataclass(frozen=True)
class Source:
    """One file of a log that comes in several.

    Attributes:
        name: for messages; file: its path beside the log's, with ``{run}`` for the log's name.
        layout: how it is read.
    """

    name: str
    file: str
    layout: Layout


@dataclass(frozen=True)
class Form:
    """How a log is stored: as one table, or as several files.

    Attributes:
        layout: of one table, and what the sources share.
        sources: the files; empty for one table.
        gap: seconds between two samples over which inputs and truth are interpolated.
        first, last: seconds after the log's first row between which rows are kept, the last
            one not included: parts of one recording share no row.
        sure: channels whose unit is stated, and ``time`` where its format is.
    """

    layout: Layout = field(default_factory=Layout)
    sources: tuple[Source, ...] = ()
    gap: float | None = None
    first: float = 0.0
    last: float = math.inf
    sure: frozenset[str] = frozenset()

    def __post_init__(self) -> None:
        if not self.first < self.last:
            raise InputError(f"log: from: found {self.first:g}, expected less than {self.last:g}")


#: What ``difffilter import`` and ``difffilter simulate`` write.
PLAIN = Layout()
