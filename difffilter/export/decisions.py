"""Golden rows at which the filter's decisions are close, so that what leads to them is tested."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.filters.recipe import Recipe
from difffilter.filters.stepping import step
from difffilter.logs.log import Log
from difffilter.parameters.parameters import Values
from difffilter.parameters.values import Constants
from difffilter.running.batch import prepared
from difffilter.seeds import stream

__all__ = ["decided"]

#: Innovations tried in each row, in nominal standard deviations: each 0.5 % above the last.
SIZES = torch.logspace(-1.0, 1.7, 1280, dtype=torch.float64)
#: What becomes of rows in turn: as it is, or just below and just above where a decision falls.
TURNS = "-ba-bbaaaaab-aab-aaaaaaabba"


def decided(filter: Recipe, log: Log, values: Values, temperature: float | None, seed: int) -> Log:
    """The log with innovations, in some rows, next to where a gate decides.

    A gate shows nothing of what it compares but on which side of its bound it lies. So rows are
    made that lie 0.5 % on either side, in a random direction over the present channels, and runs
    of refused rows, so that recovery begins and ends.
    """
    constants, current, intervals = prepared(filter, log, values, None, temperature)
    generator = stream(seed, "decisions")
    z = log.z.clone()
    for k in range(log.steps):
        inputs = {name: value[k] for name, value in log.inputs.items()}
        turn = TURNS[k % len(TURNS)]
        if turn != "-":
            direction = torch.randn(len(log.channels), generator=generator, dtype=torch.float64)
            row = Measurement(z[k], intervals[k], inputs)
            z[k] = _close(filter, constants, current, row, direction, turn == "a")
        current, _ = step(filter, constants, current, Measurement(z[k], intervals[k], inputs))
    return replace(log, z=z)


def _close(
    filter: Recipe, constants: Constants, current: Belief, row: Measurement, direction: Tensor,
    above: bool,
) -> Tensor:  # fmt: skip
    """z (m,) next to the last decision along the direction, on one side; as it was without any."""
    _, record = step(filter, constants, current, row)
    deviation = record.innovation_variance.clamp_min(0.0).sqrt()
    predicted = row.z - record.innovation
    tried = predicted + SIZES.unsqueeze(-1) * deviation * direction / direction.norm()
    _, found = step(filter, constants, _many(current), row._replace(z=tried))
    taken = _taken(found)
    changes = (taken[1:] != taken[:-1]).any(-1).nonzero()
    if not len(changes):
        return row.z
    chosen: Tensor = tried[int(changes[-1]) + int(above)]
    return chosen


def _many(current: Belief) -> Belief:
    """The belief once for each size."""
    count = len(SIZES)
    memory = {name: x.expand(count, *x.shape) for name, x in current.memory.items()}
    mean, deviations = current.mean, current.deviations
    return Belief(
        mean.expand(count, *mean.shape), deviations.expand(count, *deviations.shape), memory
    )


def _taken(record: Record) -> Tensor:
    """Which channels (sizes, m) pass the gate. Weights are told as numbers: nothing hides there."""
    return record.gate > 0.5
