"""One unbatched step of a filter, traced to a scalar program."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.engine.lower import Array, Lowering
from difffilter.engine.program import Program
from difffilter.errors import EngineError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Rows
from difffilter.parameters.values import Constants
from difffilter.scoring.losses import LOSSES, LossContext

__all__ = ["Layout", "Objective", "Traced", "trace"]


#: A compiler takes minutes over more.
MOST_ITERATIONS = 64


@dataclass(frozen=True)
class Layout:
    """Names and shapes, in order, of what is passed as one row of numbers."""

    shapes: Mapping[str, tuple[int, ...]]

    @property
    def size(self) -> int:
        """How many numbers."""
        return sum(self.count(shape) for shape in self.shapes.values())

    @staticmethod
    def count(shape: tuple[int, ...]) -> int:
        """How many numbers a shape holds."""
        return int(np.prod(shape))

    def pack(self, values: Mapping[str, Tensor] | Constants, lead: tuple[int, ...]) -> Tensor:
        """(*lead, size) of tensors whose leading dimensions broadcast to ``lead``."""
        parts = []
        for name, shape in self.shapes.items():
            full = values[name].to(torch.float64).expand((*lead, *shape))
            parts.append(full.reshape((*lead, -1)))
        if not parts:
            return torch.zeros((*lead, 0), dtype=torch.float64)
        return torch.cat(parts, dim=-1).contiguous()

    def unpack(self, packed: Tensor) -> dict[str, Tensor]:
        """Tensors (*lead, *shape) of (*lead, size)."""
        found, at = {}, 0
        for name, shape in self.shapes.items():
            count = self.count(shape)
            found[name] = packed[..., at : at + count].reshape((*packed.shape[:-1], *shape))
            at += count
        return found

    def inputs(self, program: Program, group: str) -> list[Array]:
        """Arrays of input nodes, one per name."""
        made, at = [], 0
        for shape in self.shapes.values():
            count = self.count(shape)
            nodes = [program.input(group, at + i) for i in range(count)]
            made.append(np.array(nodes, dtype=object).reshape(shape))
            at += count
        return made


@dataclass(frozen=True)
class Traced:
    """The scalar program of one step.

    Attributes:
        constants, state, row: layouts of the inputs: the run's constants; belief and memory;
            measurement, dt and known inputs.
        output: layout of the record.
        next_state, results: node of each number of the new state, and of the record.
        sums, residuals: of each number that a row adds to the sums of each loss, and of those
            whose squares Gauss-Newton works on; empty without an objective.
    """

    program: Program
    constants: Layout
    state: Layout
    row: Layout
    output: Layout
    next_state: list[int]
    results: list[int]
    sums: list[list[int]]
    residuals: list[int]


@dataclass(frozen=True)
class Objective:
    """Losses to trace behind the step.

    Attributes:
        losses: names, see :data:`difffilter.scoring.losses.LOSSES`.
        context: what they need beside track and log.
        truth_states: names of the true states of a row.
    """

    losses: tuple[str, ...]
    context: LossContext
    truth_states: tuple[str, ...]


def trace(
    filter: Recipe,
    constants: Constants,
    belief: Belief,
    inputs: Mapping[str, Tensor],
    objective: Objective | None = None,
) -> Traced:
    """Trace one step for an unbatched belief and inputs (shapes are all that counts).

    With an objective, ``inputs`` hold the row's ``truth`` and ``time`` too.

    Raises:
        EngineError: an operation without a rule, named with its line; a step that is too large.
    """
    iterations = getattr(filter, "iterations", 0)
    if iterations > MOST_ITERATIONS:
        raise EngineError(
            f"engine: found {iterations} iterations, expected {MOST_ITERATIONS} or fewer "
            "(each is written out)"
        )
    dtype, memory = torch.float64, tuple(belief.memory)
    cs = [c.detach().to(dtype) for c in constants.values()]
    state = [belief.mean, belief.deviations, *belief.memory.values()]
    z, dt = torch.zeros(len(filter.channels), dtype=dtype), torch.ones((), dtype=dtype)
    row = [z, dt, *inputs.values()]
    program = Program()
    layouts = (
        Layout(_shapes(tuple(constants), cs)),
        Layout(_shapes(("mean", "deviations", *memory), state)),
        Layout(_shapes(("z", "dt", *inputs), row)),
    )
    arrays = [
        array
        for group, layout in zip(("c", "s", "r"), layouts, strict=True)
        for array in layout.inputs(program, group)
    ]
    step = _FlatStep(filter, objective, tuple(constants), memory, tuple(inputs))
    found = Lowering(program).run(step, list(zip([*cs, *state, *row], arrays, strict=True)))
    new_state, found = found[: len(state)], found[len(state) :]
    record, found = found[: len(Record._fields)], found[len(Record._fields) :]
    count = len(objective.losses) if objective else 0
    return Traced(
        program=program,
        constants=layouts[0],
        state=layouts[1],
        row=layouts[2],
        output=Layout({n: np.shape(x) for n, x in zip(Record._fields, record, strict=True)}),
        next_state=_nodes(new_state),
        results=_nodes(record),
        sums=[_nodes([part]) for part in found[:count]],
        residuals=_nodes(found[count:]),
    )


@dataclass(frozen=True)
class _FlatStep:
    """One step from a flat list of tensors to another: what is traced.

    Attributes:
        filter, objective: as for :func:`trace`.
        constants, memory, inputs: names, in the order of the tensors.
    """

    filter: Recipe
    objective: Objective | None
    constants: tuple[str, ...]
    memory: tuple[str, ...]
    inputs: tuple[str, ...]

    def __call__(self, *given: Tensor) -> list[Tensor]:
        """Constants, then the state, then the row, to the new state, the record and the sums."""
        parts = iter(given)
        constants = Constants({name: next(parts) for name in self.constants})
        mean, deviations = next(parts), next(parts)
        before = Belief(mean, deviations, {name: next(parts) for name in self.memory})
        z, dt = next(parts), next(parts)
        measurement = Measurement(z, dt, {name: next(parts) for name in self.inputs})
        after, record = self.filter.step(constants, before, measurement)
        sums, residuals = _objective(self.filter, self.objective, measurement, after, record)
        memory = (after.memory[name] for name in self.memory)
        return [after.mean, after.deviations, *memory, *record, *sums, *residuals]


def _objective(
    filter: Recipe,
    objective: Objective | None,
    measurement: Measurement,
    after: Belief,
    record: Record,
) -> tuple[list[Tensor], list[Tensor]]:
    """What one row adds to each loss's sums, and the residuals of those that have some."""
    if objective is None:
        return [], []
    inputs = {name: value.unsqueeze(0) for name, value in measurement.inputs.items()}
    time = inputs["time"]
    truth = inputs.get("truth")
    rows = Rows(
        filter.channels, time, measurement.z.unsqueeze(0), truth, objective.truth_states, inputs
    )
    taken = Record(*(x.unsqueeze(0) for x in record))
    track = filter.track(time, after.mean.unsqueeze(0), after.deviations.unsqueeze(0), taken)
    losses = [LOSSES[name] for name in objective.losses]
    sums = [loss.rows(track, rows, objective.context).squeeze(0) for loss in losses]
    residuals = [
        loss.residuals(track, rows, objective.context).squeeze(0)
        for loss in losses
        if loss.residuals is not None
    ]
    return sums, residuals


def _shapes(names: tuple[str, ...], tensors: list[Tensor]) -> dict[str, tuple[int, ...]]:
    return {name: tuple(x.shape) for name, x in zip(names, tensors, strict=True)}


def _nodes(arrays: list[Any]) -> list[int]:
    return [int(node) for array in arrays for node in np.ravel(array)]
