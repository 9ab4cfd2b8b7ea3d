"""What a tuning run remembers: one entry per validation, the best values, how it ended."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

__all__ = ["ENDS", "Best", "Course", "Entry", "Spent"]

#: How a start may end, and what is said of it.
ENDS = {
    "converged": "further steps change nothing",
    "patience": "nothing got better",
    "steps": "at its cap of steps",
    "runs": "at its budget of filter runs",
}


class Spent(NamedTuple):
    """Filter runs, as ``TuneSettings.runs`` counts them, and the seconds that they took."""

    runs: float = 0.0
    seconds: float = 0.0


class Entry(NamedTuple):
    """One validation.

    Attributes:
        start, step: which start of the optimiser, and how many steps it had made.
        training: loss before the last step; NaN before the first.
        validation: loss of the frozen, hard form on the validation data.
        runs: filter runs of this start so far.
        values: physical values by name, as plain numbers.
    """

    start: int
    step: int
    training: float
    validation: float
    runs: float
    values: Mapping[str, Any]


class Best(NamedTuple):
    """The values that validation found best; ``loss`` is infinite before the first."""

    loss: float = math.inf
    values: Mapping[str, Tensor] = {}
    step: int = 0
    start: int = 0


class Course(NamedTuple):
    """All validations of a run.

    Attributes:
        best: what is kept; entries: one per validation, in order.
        seconds: spent by the steps before each entry.
        ends: how each start ended, a key of ``ENDS``; spent: by the last start.
    """

    best: Best
    entries: tuple[Entry, ...] = ()
    seconds: tuple[float, ...] = ()
    ends: tuple[str, ...] = ()
    spent: Spent = Spent()

    def validated(self, entry: Entry, values: Mapping[str, Tensor], seconds: float) -> Course:
        """With one more validation."""
        best = self.best
        if entry.validation < best.loss:
            best = Best(entry.validation, dict(values), entry.step, entry.start)
        return self._replace(
            best=best, entries=(*self.entries, entry), seconds=(*self.seconds, seconds)
        )

    @property
    def end(self) -> str:
        """How the start ended that found the best values."""
        return self.ends[self.best.start]

    def plain(self) -> dict[str, Any]:
        """Tensors and plain data, for a resumable state."""
        data = self._asdict()
        data["best"] = self.best._asdict()
        data["entries"] = [entry._asdict() for entry in self.entries]
        data["spent"] = self.spent._asdict()
        return data

    @classmethod
    def restored(cls, data: Mapping[str, Any]) -> Course:
        """Inverse of :meth:`plain`."""
        values = {n: torch.as_tensor(v) for n, v in data["best"]["values"].items()}
        return cls(
            best=Best(**{**data["best"], "values": values}),
            entries=tuple(Entry(**entry) for entry in data["entries"]),
            seconds=tuple(data["seconds"]),
            ends=tuple(data["ends"]),
            spent=Spent(**data["spent"]),
        )
