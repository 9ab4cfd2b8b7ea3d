"""One step at a time through the compiled step, with as little as possible around it."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from functools import partial

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Record
from difffilter.engine.compiled import Job
from difffilter.engine.fused import rows_of, run_of
from difffilter.errors import EngineError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Rows
from difffilter.parameters.values import Constants

__all__ = ["Stream"]


class Stream:
    """A belief that a compiled step moves.

    Args:
        filter, constants: as for :func:`difffilter.step`.
        belief: of a single trajectory, float64.
        inputs: known inputs of a row: their shapes count.

    Raises:
        EngineError: a batch, another precision, no compiler, an operation without a rule.
    """

    def __init__(
        self, filter: Recipe, constants: Constants, belief: Belief, inputs: Mapping[str, Tensor]
    ) -> None:
        if belief.mean.dim() != 1 or belief.mean.dtype != torch.float64:
            shape, dtype = list(belief.mean.shape), belief.mean.dtype
            raise EngineError(
                f"engine fused: found a belief of shape {shape} and {dtype}, "
                "expected a single one in float64 to stream"
            )
        z = torch.zeros(1, len(filter.channels), dtype=torch.float64)
        zero = torch.zeros(1, dtype=torch.float64)
        known = {name: value.unsqueeze(0) for name, value in inputs.items()}
        log = Rows(filter.channels, zero, z, inputs=known)
        job = Job(filter, constants, log, belief, zero)
        lead, rows = rows_of(job)
        traced = run_of(job, rows, len(lead), 1)
        library = traced.library
        self._layout, self._inputs = traced.state, tuple(inputs)
        self._rows = {name: rows[name][0].contiguous().clone() for name in traced.row.shapes}
        self._z, self._dt = self._rows["z"].numpy(), self._rows["dt"].view(1).numpy()
        self._constants = traced.constants.pack(constants, ())
        self._kept = torch.zeros(traced.kept, dtype=torch.float64)
        library.constants(_at(self._constants), _at(self._kept))
        self._pointers = (ctypes.c_void_p * len(self._rows))(
            *(x.data_ptr() for x in self._rows.values())
        )
        self._state = torch.empty(traced.state.size, dtype=torch.float64)
        self._parts = [self._layout.count(shape) for shape in self._layout.shapes.values()]
        self._shapes = tuple(self._layout.shapes.values())
        self._memory = tuple(self._layout.shapes)[2:]
        self.set(belief)
        one = library.one
        one.restype = ctypes.c_long
        one.argtypes = [ctypes.c_void_p] * 6
        self._one = partial(
            one, _at(self._constants), _at(self._kept), _at(self._state), self._pointers
        )
        sizes = [traced.output.count(shape) for shape in traced.output.shapes.values()]
        self._sizes = sizes[:-2] + self._parts
        self._fields, self._size = len(sizes) - 2, sum(self._sizes)
        self._observed = traced.output.shapes["observed"]

    def set(self, belief: Belief) -> None:
        """Take another belief."""
        state = {"mean": belief.mean, "deviations": belief.deviations, **belief.memory}
        self._state.copy_(self._layout.pack(state, ()))
        self._last = self._state.clone().split_with_sizes(self._parts)

    @property
    def belief(self) -> Belief:
        """The current belief: views of what the last step wrote, which no later one changes."""
        mean, deviations, *memory = map(Tensor.view, self._last, self._shapes)
        return Belief(mean, deviations, dict(zip(self._memory, memory, strict=True)))

    def step(
        self, z: Sequence[float], dt: float, inputs: Mapping[str, Tensor]
    ) -> tuple[Record, int]:
        """The record, and 0 or 1 + the place of the first number that is not finite."""
        self._z[:] = z
        self._dt[0] = dt
        for name in self._inputs:
            self._rows[name].copy_(inputs[name])
        output = torch.empty(self._size, dtype=torch.float64)
        flags = torch.empty(2, len(self._z), dtype=torch.bool)
        bad = self._one(output.data_ptr(), flags.data_ptr())
        parts = output.split_with_sizes(self._sizes)
        fields = parts[: self._fields]
        if not bad:
            self._last = parts[self._fields :]
        record = Record(fields[0], fields[1].view(self._observed), *fields[2:], *flags.unbind())
        return record, bad

    def place(self, bad: int) -> tuple[str, int]:
        """What holds the number at 1 + its place: ``mean``, ``covariance``, and the state."""
        n, p = self._layout.shapes["mean"][0], self._layout.shapes["deviations"][0]
        at = bad - 1
        if at < n:
            return "mean", at
        return "covariance", min((at - n) // p, p - 1)


def _at(x: Tensor) -> ctypes.c_void_p:
    return ctypes.c_void_p(x.data_ptr())
