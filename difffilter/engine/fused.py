"""Run a filter over a log with the fused engine: forward, without gradient."""

from __future__ import annotations

import ctypes
from collections import OrderedDict
from collections.abc import Mapping

import torch
from torch import Tensor

from difffilter.belief import Belief, Record
from difffilter.engine.build import build
from difffilter.engine.emit import source
from difffilter.engine.trace import Traced, trace
from difffilter.errors import InputError
from difffilter.filter import Filter
from difffilter.log import Log
from difffilter.parameters import Values

__all__ = ["forward"]

Results = tuple[Tensor, Tensor, Record, Belief]
#: The last traced steps, by filter and shapes; the filter is kept so that its id stays its own.
_KEPT: OrderedDict[tuple[object, ...], tuple[Filter, Traced, str]] = OrderedDict()
MOST = 64


def forward(
    filter: Filter, constants: Values, log: Log, start: Belief, intervals: Tensor
) -> Results:
    """Means (T, ..., n), deviations (T, ..., n, n), the record and the last belief.

    Args:
        filter, constants: as for :func:`difffilter.step`.
        log: z (T, m) or (T, ..., m); start: fitted to its trajectories.
        intervals: dt before each row, (T,) or (T, ...).

    Raises:
        InputError: not float64; an operation without a rule, named with its line; no
            compiler.
    """
    if log.z.dtype != torch.float64:
        raise InputError(f"engine fused: found {log.z.dtype}, expected float64")
    lead = tuple(log.z.shape[1:-1])
    inputs = {name: _per_row(value, lead) for name, value in log.inputs.items()}
    traced, text = _traced(filter, constants, start, inputs, len(lead))
    rows = {"z": log.z, "dt": _per_row(intervals, lead), **inputs}
    state = {"mean": start.mean, "deviations": start.deviations, **start.memory}
    packed = [
        traced.constants.pack(constants, ()),
        traced.state.pack(state, lead),
        traced.row.pack(rows, (log.steps, *lead)),
    ]
    size = log.z[0, ..., 0].numel()
    made = [
        torch.empty(log.steps, size, max(width, 1), dtype=torch.float64)
        for width in (traced.state.size, traced.output.size)
    ]
    pointers = [ctypes.c_void_p(x.data_ptr()) for x in (*packed, *made)]
    build(text).run(ctypes.c_long(log.steps), ctypes.c_long(size), *pointers)
    states, outputs = (x.reshape(log.steps, *lead, -1) for x in made)
    found, fields = traced.state.unpack(states), traced.output.unpack(outputs)
    for name in ("present", "isolated"):
        fields[name] = fields[name] != 0.0
    means, deviations = found.pop("mean"), found.pop("deviations")
    final = Belief(means[-1], deviations[-1], {name: value[-1] for name, value in found.items()})
    return means, deviations, Record(**fields), final


def _traced(
    filter: Filter, constants: Values, start: Belief, inputs: Mapping[str, Tensor], lead: int
) -> tuple[Traced, str]:
    """The traced step and its C source, from memory where filter and shapes are the same."""

    def single(x: Tensor, first: int) -> Tensor:
        return x[(0,) * first]

    one = Belief(
        single(start.mean, lead),
        single(start.deviations, lead),
        {name: single(value, lead) for name, value in start.memory.items()},
    )
    row = {name: single(value, 1 + lead) for name, value in inputs.items()}
    shapes = tuple(
        (name, tuple(x.shape)) for part in (constants, one.memory, row) for name, x in part.items()
    )
    key = (id(filter), shapes)
    if key not in _KEPT:
        traced = trace(filter, constants, one, row)
        _KEPT[key] = (filter, traced, source(traced))
        if len(_KEPT) > MOST:
            _KEPT.popitem(last=False)
    _KEPT.move_to_end(key)
    _, traced, text = _KEPT[key]
    return traced, text


def _per_row(x: Tensor, lead: tuple[int, ...]) -> Tensor:
    """(T,), shared by all trajectories, as (T, ...); others as they are."""
    return x.reshape(-1, *[1] * len(lead)).expand(-1, *lead) if x.dim() == 1 else x
