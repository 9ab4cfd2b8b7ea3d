"""What validates a tuning on recorded logs: logs of its own, or a part that is held back."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief
from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.tuning.data import Batch, blank, concatenate

__all__ = ["Check", "hold_back"]

#: Logs from which on whole ones are held back, every so many; of fewer, the last share of rows.
EVERY, SHARE = 5, 0.2
#: Rows below which nothing can be held back.
LEAST = 10


class Check(NamedTuple):
    """Validation data.

    Attributes:
        log: with a start; told: what was held back, in words; empty where nothing was.
        before: rows before those of ``log``, which bring the belief there; None where the
            log starts by itself.
    """

    log: Log
    told: str
    before: Log | None = None

    def select(self, index: Tensor) -> Check:
        """Some of its trajectories."""
        before = None if self.before is None else self.before.select(index)
        return self._replace(log=self.log.select(index), before=before)

    def batch(self, filter: Recipe, values: Values, engine: str) -> Batch:
        """The log, started; the filter runs up to it with these values where it must."""
        start: Belief | None = None
        if self.before is not None:
            start = run(filter, self.before, values, engine=engine).final
        given = start if start is not None else self.log.start
        assert given is not None
        return Batch(self.log, given)


def hold_back(log: Log, filter: Recipe) -> tuple[Log, Check]:
    """A part of started logs to validate on; the rest trains.

    Of five logs or more, every fifth; of fewer, the last fifth of the rows of each, started from
    the belief that the filter has after the rows before.

    Raises:
        InputError: too few rows to hold any back.
    """
    count = log.trajectories
    if count >= EVERY:
        kept = [i for i in range(count) if i % EVERY != EVERY - 1]
        held = [i for i in range(count) if i % EVERY == EVERY - 1]
        names = ", ".join(log.names[i] or str(i + 1) for i in held) if log.names else str(held)
        return log.select(kept), Check(log.select(held), f"held back: {names}")
    if log.steps < LEAST:
        raise InputError(
            f"validation: found {log.steps} rows, expected {LEAST} or more to hold some back, "
            "or logs to validate on"
        )
    at = log.steps - max(int(SHARE * log.steps), 1)
    before, after = log.rows(0, at), log.rows(at, log.steps)
    if not bool(after.measured.any()):
        raise InputError("validation: found no measurement in the last fifth of the rows")
    tail = concatenate([blank(log.rows(at - 1, at)), after])
    since = float(torch.as_tensor(after.time[0]).min())
    told = f"held back: the last {log.steps - at} of {log.steps} rows, from {since:.10g} s"
    return before, Check(tail, told, before)
