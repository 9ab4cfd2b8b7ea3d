"""Values held to their guards: no member of a family worse than it may be, with its interval.

The hinges of the loss ``worlds`` see the training trajectories, each member a share of them:
what they just allow there is now and then too much elsewhere. So the members are drawn anew,
larger, and values that fail there go back towards the published ones, along the straight line of
unconstrained numbers, until none fails. At its end stand the published values, which never do.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.family import Family, Member
from difffilter.logs.log import Log
from difffilter.parameters.parameters import ParameterSet, Values
from difffilter.running.batch import run
from difffilter.scoring.metrics import Score, paired_ratio, scored_rows, squared_error

__all__ = ["SHARES", "Held", "held_to", "toward"]

#: Trajectories of each member.
COUNT = 500
#: Shares of the way from the published values that are tried, the longest first.
SHARES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2, 0.1)


class Held(NamedTuple):
    """Values that no guard objects to.

    Attributes:
        values: physical; share: of the way from the published values, 1 for all of it.
        worst: the member with the largest upper end of the ratio to published under the tuned
            values; upper: that end.
    """

    values: Values
    share: float
    worst: str
    upper: float


class _Guard:
    """One member's trajectories, and the published filter's squared errors there."""

    def __init__(
        self, member: Member, filter: Recipe, log: Log, score: Score | str, engine: str
    ) -> None:
        self.member, self.filter, self.score, self.engine = member, filter, score, engine
        self.log = log.only(filter.channels)
        self.squared, self.rows = self._errors(None)

    def _errors(self, values: Values | None) -> tuple[Tensor, Tensor]:
        log = self.log
        if log.start is None:
            if self.member.starter is None:
                raise InputError(f"world {self.member.name}: found no start, expected one")
            log = self.member.starter(self.filter, log, values)
        track = run(self.filter, log, values, engine=self.engine)
        return squared_error(log, track, self.score), scored_rows(log, track, self.score)

    def upper(self, values: Values) -> float:
        """Upper end of the 95 % interval of the ratio to published, over what is allowed."""
        squared, rows = self._errors(values)
        return paired_ratio(squared, self.squared, rows & self.rows)[2] / self.member.allow


def held_to(
    family: Family,
    filter: Recipe,
    values: Values,
    seed: int,
    *,
    score: Score | str = "all",
    engine: str = "auto",
) -> Held:
    """The values, or as much of them as every member of the family allows.

    Args:
        values: tuned; seed: of the trajectories, whose purpose is ``guard``.
        score: of which states errors are.
        engine: as for :func:`difffilter.run`.
    """
    with torch.no_grad():
        guards = [
            _Guard(member, filter, member.log(COUNT, seed, "guard"), score, engine)
            for member in family
        ]
        found = {guard.member.name: guard.upper(values) for guard in guards}
        worst = max(found, key=lambda name: found[name])
        upper = found[worst] * family[worst].allow
        # Those that object first, so that a share that fails costs little.
        guards.sort(key=lambda guard: -found[guard.member.name])
        if found[worst] <= 1.0:
            return Held(values, 1.0, worst, upper)
        for share, tried in _shares(filter, values):
            if all(guard.upper(tried) <= 1.0 for guard in guards):
                return Held(tried, share, worst, upper)
    return Held(filter.published(), 0.0, worst, upper)


def _shares(filter: Recipe, values: Values) -> Iterator[tuple[float, Values]]:
    for share in SHARES[1:]:
        yield share, toward(filter, values, share)


def toward(filter: Recipe, values: Values, share: float) -> Values:
    """Values a share of the way from the published ones, in unconstrained numbers."""
    mine, published = (ParameterSet(filter.declarations, v) for v in (values, None))
    with torch.no_grad():
        for one, other in zip(mine.free().values(), published.free().values(), strict=True):
            one.copy_(other + share * (one - other))
    return mine.frozen_values()
