"""Times as files have them: seconds, Unix times, ISO 8601; and back."""

from __future__ import annotations

import re
from collections.abc import Sequence
from datetime import UTC, datetime
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import NDArray

from difffilter.errors import InputError

__all__ = ["FORMATS", "Clock", "iso_time", "read_times"]

#: Seconds in one unit of each format of numbers, and whether it counts from 1970 (UTC).
FORMATS: dict[str, tuple[float, bool]] = {
    "s": (1.0, False), "ms": (1e-3, False), "us": (1e-6, False), "ns": (1e-9, False),
    "unix": (1.0, True), "unix-ms": (1e-3, True), "unix-us": (1e-6, True), "unix-ns": (1e-9, True),
    "iso": (1.0, True),
}  # fmt: skip
#: Decimal places that are written, of Unix times.
PLACES = {"unix": 6, "unix-ms": 3, "unix-us": 3, "unix-ns": 0}
ISO = re.compile(r"(.+?)(?:[.,](\d+))?(Z|[+-]\d\d(?::?\d\d)?)?")
#: A time in seconds beyond it (some 3000 years) is none.
BEYOND = 1e11

Array = NDArray[np.float64]


class Clock:
    """How a log's times are written, and from when its seconds count.

    Attributes:
        format: one of :data:`FORMATS`; origin: the Unix time of second 0; None where times
            count from no date.
    """

    def __init__(self, format: str = "s", origin: float | None = None) -> None:
        self.format, self.origin = format, origin

    @property
    def words(self) -> str:
        """From when seconds count, in words."""
        return "undated" if self.origin is None else f"seconds from {iso_time(0.0, self.origin)}"

    def write(self, seconds: Array) -> list[str]:
        """Times of a log as its file has them."""
        scale, dated = FORMATS[self.format]
        if self.format == "iso":
            return [iso_time(float(value), self.origin or 0.0) for value in seconds]
        if not dated:
            return [repr(value) for value in (seconds / scale).tolist()]
        places = PLACES[self.format]
        each = 10**places / scale  # of what is written, in a second
        whole = int(self.origin or 0.0)
        ticks = np.rint((seconds + ((self.origin or 0.0) - whole)) * each).astype(np.int64)
        found = []
        for tick in ticks.tolist():
            head, tail = divmod(whole * round(each) + tick, 10**places)
            text = f"{head}.{tail:0{places}d}" if places else f"{head}"
            found.append(text.rstrip("0").rstrip(".") if places else text)
        return found


def iso_time(seconds: float, origin: float) -> str:
    """ISO 8601, UTC, to the microsecond."""
    when = datetime.fromtimestamp(int(origin), UTC)
    micros = round((seconds + origin - int(origin)) * 1e6)
    whole = datetime.fromtimestamp(when.timestamp() + micros // 10**6, UTC)
    return f"{whole:%Y-%m-%dT%H:%M:%S}.{micros % 10**6:06d}Z"


def read_times(
    values: Array | Sequence[str], format: str, zone: str, origin: float | None
) -> tuple[Array, float | None]:
    """Seconds since the origin, and the origin (the first time, rounded down, if None).

    Raises:
        InputError: ``at`` tells the row: a text that is no such time.
    """
    scale, dated = FORMATS[format]
    if format == "iso":
        whole, part = _iso(values, zone)
        start = float(whole.min()) if origin is None else origin
        return (whole - int(start)) + part - (start - int(start)), start
    numbers, exact = _numbers(values)
    if not dated:
        return numbers * scale, None
    start = float(np.floor(np.nanmin(numbers) * scale)) if origin is None else origin
    if exact is not None:  # whole milliseconds, microseconds or nanoseconds: no digit is lost
        first = round(start / scale)
        return (exact - first).astype(np.float64) * scale + (first * scale - start), start
    return numbers * scale - start, start


class TimeError(InputError):
    """A text that is no time; ``row`` counts from 0."""

    def __init__(self, row: int, text: str) -> None:
        super().__init__(text)
        self.row = row


def _numbers(values: Array | Sequence[str]) -> tuple[Array, NDArray[np.int64] | None]:
    if isinstance(values, np.ndarray) and values.dtype.kind in "iu":
        return values.astype(np.float64), values.astype(np.int64)
    if isinstance(values, np.ndarray) and values.dtype.kind == "f":
        return values, None
    try:
        exact = np.array([int(text) for text in values], dtype=np.int64)
        return exact.astype(np.float64), exact
    except (ValueError, OverflowError):
        pass
    numbers = np.empty(len(values))
    for row, text in enumerate(values):
        try:
            numbers[row] = float(text) if str(text).isascii() and "_" not in str(text) else np.nan
        except ValueError:
            numbers[row] = np.nan
        if not np.isfinite(numbers[row]):
            raise TimeError(row, "a finite number")
    return numbers, None


def _iso(values: Array | Sequence[str], zone: str) -> tuple[NDArray[np.int64], Array]:
    """Whole Unix seconds and the fraction, of ISO 8601 texts."""
    own = ZoneInfo(zone) if zone else UTC
    whole, part = np.empty(len(values), dtype=np.int64), np.zeros(len(values))
    zoned: bool | None = None
    for row, text in enumerate(values):
        matched = ISO.fullmatch(str(text).strip())
        try:
            if matched is None or len(matched[1]) < 10:
                raise ValueError
            moment = datetime.fromisoformat(matched[1] + (matched[3] or ""))
        except ValueError:
            raise TimeError(row, "a time in ISO 8601, as 2021-05-04T07:54:51.85Z") from None
        if zoned is not None and zoned != (moment.tzinfo is not None):
            raise TimeError(row, "a time zone in every row, or in none")
        zoned = moment.tzinfo is not None
        whole[row] = int((moment if zoned else moment.replace(tzinfo=own)).timestamp())
        part[row] = float(f"0.{matched[2]}") if matched[2] else 0.0
    return whole, part
