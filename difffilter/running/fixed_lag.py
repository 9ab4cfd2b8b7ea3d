"""A tracker's second output, some seconds late and better for it."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.errors import InputError
from difffilter.running.links import Estimates, Links, check_smoothable, link, step_back
from difffilter.running.rows import Given, Known, numbers
from difffilter.running.tracker import Tracker

__all__ = ["Delayed", "FixedLag"]


class Delayed(NamedTuple):
    """An estimate that has waited for what came after it.

    Attributes:
        time: of its row, s since the tracker's start.
        mean: (..., n); deviations: (..., n, n).
    """

    time: float
    mean: Tensor
    deviations: Tensor

    @property
    def covariance(self) -> Tensor:
        """(..., n, n)."""
        return self.deviations @ self.deviations.mT


class Kept(NamedTuple):
    """A row that waits: its filtered belief, and the link to the row after it, once there."""

    time: float
    belief: Belief
    link: Links | None = None


class FixedLag:
    """A tracker whose estimates come a second time, from all rows until ``lag`` seconds later.

    The same as ``smooth(..., lag=lag)``. Each row costs a step of torch and, once the lag is
    over, a way back over the rows within it; memory is that of these rows.

    Args:
        tracker: with rows in order (without ``history``), of a filter that can be smoothed.
        lag: s.

    Raises:
        InputError: a lag that is none, a tracker with history, a recipe that has no one
            Gaussian model from row to row.

    Example:
        >>> from difffilter import ConstantVelocity, Filter, FixedLag, Position, Tracker
        >>> recipe = Filter(ConstantVelocity(axes=1), (Position(axes=1, sigma=2.0),))
        >>> late = FixedLag(Tracker(recipe, [0.0, 1.0], [[4.0, 0.0], [0.0, 1.0]]), lag=2.0)
        >>> found = [late.step([1.0 * k], dt=1.0)[1] for k in range(5)]
        >>> print(*(row.time for rows in found for row in rows))
        1.0 2.0
    """

    def __init__(self, tracker: Tracker, lag: float) -> None:
        if not 0.0 <= lag < math.inf:
            raise InputError(f"lag: found {lag}, expected 0 or more seconds")
        self._filter = check_smoothable(tracker.filter)
        if tracker._history is not None:
            raise InputError("lag: found a tracker with history, expected rows in order")
        self.tracker, self.lag = tracker, lag
        self._time = 0.0
        self._rows: list[Kept] = []

    def step(
        self, z: Given, dt: float, inputs: Known | None = None
    ) -> tuple[Record, list[Delayed]]:
        """The tracker's step, and the estimates whose lag is over, the oldest first.

        Raises:
            InputError, NonFiniteError: as for :meth:`Tracker.step`; all stays as it was.
        """
        record = self.tracker.step(z, dt, inputs)
        after, now = self.tracker.belief, self._time + float(dt)
        due = sum(row.time + self.lag < now for row in self._rows)
        found = self._back(due)
        del self._rows[:due]
        if self._rows:
            last = self._rows[-1]
            self._rows[-1] = last._replace(link=self._link(last.belief, z, dt, inputs, record))
        self._rows.append(Kept(now, after))
        self._time = now
        return record, found

    def flush(self) -> list[Delayed]:
        """The estimates that still wait, from what is there: the end of a stream."""
        found = self._back(len(self._rows))
        self._rows = []
        return found

    def _link(
        self, before: Belief, z: Given, dt: float, inputs: Known | None, record: Record
    ) -> Links:
        with torch.inference_mode():
            kind = before.mean.dtype
            known = {n: torch.as_tensor(x, dtype=kind) for n, x in (inputs or {}).items()}
            row = torch.as_tensor(numbers(z, self._filter.channels), dtype=kind)
            measurement = Measurement(row, torch.as_tensor(dt, dtype=kind), known)
            constants = self.tracker._constants
            return link(self._filter, constants, before, measurement, record.prior_weight)

    def _back(self, count: int) -> list[Delayed]:
        """The first ``count`` rows from all that there are."""
        if not count:
            return []
        found: list[Delayed] = []
        with torch.inference_mode():
            newest = self._rows[-1].belief
            now: Estimates = newest.mean, newest.deviations
            for i in reversed(range(len(self._rows))):
                row = self._rows[i]
                if row.link is not None:
                    mean, links = row.belief.mean, row.link
                    now = step_back(self._filter.motion, mean, links.predicted, links.back, now)
                if i < count:
                    found.append(Delayed(row.time, *now))
        return found[::-1]
