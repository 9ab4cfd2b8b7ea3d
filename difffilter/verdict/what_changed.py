"""What tuning changed, what each change is worth, and what each costs to take back."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from difffilter.comparison.held_out import HeldOut, Outcome
from difffilter.logs.log import Log
from difffilter.scenario.checkpoint import Checkpoint

__all__ = ["Change", "changes", "honest"]


@dataclass(frozen=True)
class Change:
    """One tuned parameter, and the filter with this one alone at its published value.

    Attributes:
        name, unit: of the parameter.
        entries: (name, published, tuned, standard error or None) of each number.
        ratio: held-out RMSE with the parameter reverted, divided by that of the tuned filter,
            with its paired 95 % interval: above 1 the change is worth something.
        nees_per_state: of the filter with the parameter reverted; 1 expected.
        given: unit that the published value was given in, and its factor to ``unit``.
        keep: whether the published value costs nothing: the interval reaches down to 1, and
            consistency does not leave [0.5, 2] where it was inside.
    """

    name: str
    unit: str
    entries: tuple[tuple[str, float, float, float | None], ...]
    ratio: tuple[float, float, float]
    nees_per_state: float
    keep: bool
    given: tuple[str, float] | None = None

    def sigmas(self) -> list[float | None]:
        """(tuned - published) / standard error of each number; None where there is none."""
        return [
            None if error is None or error == 0.0 else (after - before) / error
            for _, before, after, error in self.entries
        ]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return dict(vars(self)) | {"sigmas": self.sigmas()}


def changes(
    checkpoint: Checkpoint, log: Log, *, engine: str = "auto", tuned: Outcome | None = None
) -> list[Change]:
    """Each tuned parameter of a checkpoint, reverted alone on held-out trajectories.

    Args:
        log: held out, with truth; started for each set of values as in a comparison.
        tuned: what the tuned values gave there, where that is known.

    Raises:
        InputError: a log without truth.
    """
    filter = checkpoint.published_filter
    errors = checkpoint.training.get("standard_errors", {})
    held = HeldOut(checkpoint.scenario, filter, log, checkpoint.temperature, engine)
    tuned = held.outcome(checkpoint.values) if tuned is None else tuned
    found = []
    for name, parameter in filter.declarations.items():
        if not parameter.tuned:
            continue
        before, after = parameter.tensor(), checkpoint.values[name]
        reverted = held.outcome({**checkpoint.values, name: before})
        ratio = reverted.ratio(tuned)
        each = zip(parameter.entries(), before.reshape(-1), after.reshape(-1), strict=True)
        entries = tuple((n, float(b), float(a), errors.get(n)) for n, b, a in each)
        free = ratio[1] <= 1.0 and ratio[0] < 1.01
        keep = free and (honest(reverted.nees) or not honest(tuned.nees))
        change = Change(
            name=name,
            unit=parameter.unit,
            entries=entries,
            ratio=ratio,
            nees_per_state=reverted.nees,
            keep=keep,
            given=parameter.given,
        )
        found.append(change)
    return found


def honest(nees: float) -> bool:
    """Whether errors are about as large as claimed: a NEES per state from 0.5 to 2."""
    return math.isfinite(nees) and 0.5 <= nees <= 2.0
