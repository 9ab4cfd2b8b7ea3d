"""Rows that come late: back to the belief before them, and again what came since."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from difffilter.core.beliefs import Belief, Record
from difffilter.errors import DifffilterError, InputError

__all__ = ["After", "History"]

#: The belief after a row, and the row's record.
After = tuple[Belief, Record]


@dataclass(frozen=True)
class Row:
    """A row that was taken, and the belief after it."""

    time: float
    z: Any
    inputs: Mapping[str, Any] | None
    belief: Belief


class History:
    """Rows of the last seconds, so that a late one finds its place.

    The belief is that of all rows in order of time; rows of equal time in order of arrival.
    Memory is that of the rows within ``seconds`` of the newest.

    Args:
        seconds: how late a row may be; time: of the first belief, s; None for the first row's.
        belief: the first one.
    """

    def __init__(self, seconds: float, time: float | None, belief: Belief) -> None:
        if not seconds >= 0.0:
            raise InputError(f"history: found {seconds}, expected 0 or more seconds")
        self.seconds = seconds
        self.dropped = 0
        self._before, self._belief = time, belief
        self._whole = True  # whether no row was forgotten yet
        self._rows: list[Row] = []

    def take(
        self,
        time: float,
        z: Any,
        inputs: Mapping[str, Any] | None,
        step: Callable[[Belief, Any, float, Mapping[str, Any] | None], After],
    ) -> After | None:
        """The newest belief with the row in its place, and the row's record.

        Returns:
            None where the row is older than the history.

        Raises:
            InputError: a time that is not finite, or before the first belief's; as ``step``: the
                history stays as it was.
        """
        if not abs(time) < float("inf"):
            raise InputError(f"time: found {time}, expected a finite number")
        newest = self._rows[-1].time if self._rows else self._before
        if newest is not None and time < newest - self.seconds:
            self.dropped += 1
            return None
        if self._whole and self._before is not None and time < self._before:
            raise InputError(f"time: found {time}, before the start's {self._before}")
        at = bisect_right([row.time for row in self._rows], time)
        rows, after = self._rows[:at], [Row(time, z, inputs, self._belief), *self._rows[at:]]
        belief = rows[-1].belief if rows else self._belief
        before = rows[-1].time if rows else self._before
        found: Record | None = None
        for row in after:
            dt = 0.0 if before is None else row.time - before
            belief, record = step(belief, row.z, dt, row.inputs)
            found = record if found is None else found
            rows.append(Row(row.time, row.z, row.inputs, belief))
            before = row.time
        limit = rows[-1].time - self.seconds
        old = sum(row.time < limit for row in rows)
        if old:
            self._before, self._belief = rows[old - 1].time, rows[old - 1].belief
            self._whole = False
        self._rows = rows[old:]
        if found is None:
            raise DifffilterError("history: took no row")
        return belief, found
