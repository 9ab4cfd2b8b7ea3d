"""Sets of values of one filter on the same held-out log."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from difffilter.engine.choice import settled
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.scenario.case import Case
from difffilter.scenario.estimation import estimate, started
from difffilter.scoring.differences import scored_unit
from difffilter.scoring.directions import mean_directions
from difffilter.scoring.metrics import mean_nees, paired_ratio, scored_rows, squared_error

__all__ = ["HeldOut", "Outcome", "as_it_is"]


def as_it_is(log: Log) -> Log:
    """The log."""
    return log


@dataclass(frozen=True)
class Outcome:
    """What one set of values gave.

    Attributes:
        track: of the whole log.
        squared: (T, ...), squared errors of the scored states (the position's, m^2).
        rows: (T, ...), those that count.
        rmse: their root mean square error; unit: of that error, empty for several.
        nees: mean NEES per state, 1 expected.
        directions: mean NEES along each principal direction of P, 1 expected.
    """

    track: Track
    squared: Tensor
    rows: Tensor
    rmse: float
    nees: float
    directions: Mapping[str, float] = field(default_factory=dict)
    unit: str = "m"

    def ratio(self, to: Outcome) -> tuple[float, float, float]:
        """RMSE divided by that of another, over the rows of both, with its 95 % interval."""
        return paired_ratio(self.squared, to.squared, self.rows & to.rows)


@dataclass(frozen=True)
class HeldOut:
    """A log with truth that nobody tuned on, and who runs over it; no run is made twice.

    Attributes:
        scenario: says how a run starts and which rows count.
        filter: the recipe.
        log: with truth.
        temperature: None for the hard form.
        engine: as for :func:`difffilter.run`.
    """

    scenario: Case
    filter: Recipe
    log: Log
    temperature: float | None = None
    engine: str = "auto"
    _known: dict[Any, Outcome] = field(default_factory=dict, init=False, repr=False, compare=False)

    @cached_property
    def chosen(self) -> str:
        """The engine of many runs: ``auto`` compiles where that is possible at all."""
        some = list(range(min(8, self.log.trajectories)))
        few = self.log.select(some) if self.log.z.dim() > 2 else self.log

        def trial() -> Track:
            return run(self.filter, started(self.scenario, self.filter, few), engine="fused")

        return settled(self.engine, trial, math.inf)

    def outcome(
        self, values: Values | None = None, start: Callable[[Log], Log] = as_it_is
    ) -> Outcome:
        """Run with some values (the published ones if None), started as they start.

        Args:
            start: changes the started log.

        Raises:
            InputError: a log without truth.
        """
        values = self.filter.published() if values is None else values
        numbers = tuple(tuple(values[name].reshape(-1).tolist()) for name in sorted(values))
        if (numbers, start) not in self._known:
            self._known[numbers, start] = self._run(values, start)
        return self._known[numbers, start]

    def _run(self, values: Values, start: Callable[[Log], Log]) -> Outcome:
        ready = start(started(self.scenario, self.filter, self.log, values))
        with torch.no_grad():
            track = estimate(
                self.filter, ready, values, temperature=self.temperature, engine=self.chosen
            )
        rows = scored_rows(self.log, track, self.scenario.score)
        squared = squared_error(self.log, track, self.scenario.score)
        error = float(squared[rows].mean().sqrt())
        nees = float(mean_nees(self.log, track, rows))
        return Outcome(
            track=track,
            squared=squared,
            rows=rows,
            rmse=error,
            nees=nees,
            directions=mean_directions(self.log, track, rows),
            unit=scored_unit(self.log, track, self.scenario.score),
        )
