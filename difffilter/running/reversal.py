"""The way back as a recipe: its rows run from the last to the first, by any engine.

The belief is the next row's smoothed one, a row brings the filtered one and what leads from it
to the next row, and the step is one of the smoother. So the engine traces and compiles it like
any other step.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.engine.fused import Job, forward
from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Rows
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants
from difffilter.running.links import Estimates, link, step_back

__all__ = ["Reversed", "compiled_back"]

MEAN, DEVIATIONS = "filtered.mean", "filtered.deviations"


@dataclass(frozen=True)
class Reversed(Recipe):
    """One step back of a filter whose prediction nothing adapts.

    Attributes:
        filter: whose way back it is.
    """

    filter: Filter

    @property
    def states(self) -> tuple[str, ...]:
        return self.filter.states

    @property
    def channels(self) -> tuple[str, ...]:
        return ()

    @property
    def declarations(self) -> dict[str, Parameter]:
        return self.filter.declarations

    def with_values(self, values: Values) -> Self:
        return type(self)(self.filter.with_values(values))

    def prepare(self, values: Values | None = None, temperature: float | None = None) -> Constants:
        return self.filter.prepare(values, temperature)

    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        self.filter.check_inputs(inputs)

    def start(self, mean: Tensor, deviations: Tensor) -> Belief:
        return Belief(mean, deviations)

    def step(
        self, constants: Constants, belief: Belief, measurement: Measurement
    ) -> tuple[Belief, Record]:
        """From the next row's smoothed belief to this row's; the record is empty."""
        inputs = dict(measurement.inputs)
        at = Belief(inputs.pop(MEAN), inputs.pop(DEVIATIONS))
        found = link(self.filter, constants, at, measurement._replace(inputs=inputs))
        now = step_back(
            self.filter.motion,
            at.mean,
            found.predicted,
            found.back,
            (belief.mean, belief.deviations),
        )
        none = at.mean[..., :0]
        wide = at.deviations[..., :0, :]
        empty = Record(none, wide, *[none] * (len(Record._fields) - 2))
        return Belief(*now), empty


def compiled_back(
    filter: Filter, constants: Constants, log: Log, track: Track, intervals: Tensor
) -> Estimates:
    """Smoothed means and deviations of all rows, by the compiled step.

    Raises:
        EngineError: as for :func:`difffilter.engine.fused.forward`.
    """
    lead = log.z.shape[1:-1]
    inputs = {name: value[1:].flip(0) for name, value in log.inputs.items()}
    inputs |= {MEAN: track.mean[:-1].flip(0), DEVIATIONS: track.deviations[:-1].flip(0)}
    rows = Rows(
        channels=(),
        time=log.time[1:].flip(0),
        z=log.z.new_zeros(log.steps - 1, *lead, 0),
        inputs=inputs,
    )
    last = Belief(track.mean[-1], track.deviations[-1])
    job = Job(Reversed(filter), constants, rows, last, intervals[1:].flip(0))
    mean, deviations, _, _ = forward(job)
    return (
        torch.cat([mean.flip(0), last.mean.unsqueeze(0)]),
        torch.cat([deviations.flip(0), last.deviations.unsqueeze(0)]),
    )
