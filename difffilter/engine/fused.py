"""Run a filter, or sum its losses with their gradient, by a compiled step."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping, Sequence
from math import prod
from typing import Any, NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Record
from difffilter.engine.compiled import Compiled, Job, compiled
from difffilter.engine.kernels import run_source, sums_source, width_for
from difffilter.engine.trace import Layout, Objective, Traced
from difffilter.errors import EngineError

__all__ = ["Job", "Tangents", "forward", "rows_of", "run_of", "sums"]

Results = tuple[Tensor, Tensor, Record, Belief]


class Tangents(NamedTuple):
    """Derivatives towards p directions: of the packed constants (p, C), of starts or None.

    Attributes:
        active: names of the constants that have any.
        start: (p, ..., S), or None where the start has none.
    """

    constants: Tensor
    active: frozenset[str]
    start: Tensor | None


def forward(job: Job) -> Results:
    """Means (T, ..., n), deviations (T, ..., n, n), the record and the last belief.

    Raises:
        EngineError: not float64; an operation without a rule, named with its line; no
            compiler.
    """
    lead, rows = rows_of(job)
    steps, size = job.log.steps, prod(lead)
    step = run_of(job, rows, len(lead), width_for(size))
    made = [
        torch.empty(steps, size, max(count, 1), dtype=torch.float64)
        for count in (step.state.size, step.output.size)
    ]
    step.library.run(*_arguments(step, job, rows, lead), *(_pointer(x) for x in made))
    states, outputs = (x.reshape(steps, *lead, -1) for x in made)
    found, fields = step.state.unpack(states), step.output.unpack(outputs)
    for name in ("present", "isolated"):
        fields[name] = fields[name] != 0.0
    means, deviations = found.pop("mean"), found.pop("deviations")
    final = Belief(means[-1], deviations[-1], {name: value[-1] for name, value in found.items()})
    return means, deviations, Record(**fields), final


def sums(
    job: Job, objective: Objective, tangents: Tangents | None
) -> tuple[tuple[int, ...], Tensor, Tensor, Tensor, Tensor]:
    """What the rows of each trajectory add to the losses' sums, with derivatives.

    Returns:
        how many sums each loss has, the sums (B, q), their tangents (B, p, q), J^T J of the
        residuals (B, p, p), and the first step with a belief that is not finite (B,), -1 for
        none. p = 0 without tangents.

    Raises:
        EngineError: as for :func:`forward`.
    """
    lead, rows = rows_of(job, objective)
    moving = tangents.active if tangents else frozenset[str]()
    given = tangents.start if tangents else None
    size = prod(lead)
    width = width_for(size)

    def source(traced: Traced) -> str:
        active = _places(traced.constants, moving) if tangents else None
        states = set() if given is None else set(range(traced.state.size))
        return sums_source(traced, active, states, width)

    kind = ("sums", tangents is None, tuple(sorted(moving)), given is None, width)
    step = compiled(job, rows, len(lead), kind, source, objective)
    p = len(tangents.constants) if tangents else 0
    q = sum(step.sums)
    total, dtotal = torch.zeros(size, q, dtype=torch.float64), torch.zeros(size, p, q).double()
    gram, bad = torch.zeros(size, p, p).double(), torch.zeros(size, dtype=torch.long)
    dc = tangents.constants.contiguous() if tangents else total
    ds = None if given is None else given.reshape(p, size, -1).contiguous()
    failed = step.library.sums(
        *_arguments(step, job, rows, lead),
        ctypes.c_long(p),
        _pointer(dc),
        None if ds is None else _pointer(ds),
        *(_pointer(x) for x in (total, dtotal, gram, bad)),
    )
    if failed:
        raise EngineError("engine fused: found no memory for its tangents")
    return step.sums, total, dtotal, gram, bad


def run_of(job: Job, rows: Mapping[str, Tensor], lead: int, width: int) -> Compiled:
    """The compiled run with so many lanes."""
    return compiled(job, rows, lead, ("run", width), lambda t: run_source(t, width))


def rows_of(
    job: Job, objective: Objective | None = None
) -> tuple[tuple[int, ...], dict[str, Tensor]]:
    """Leading dimensions, and what a row holds: (T, *lead, ...) by name, broadcast."""
    log = job.log
    if log.z.dtype != torch.float64:
        raise EngineError(f"engine fused: found {log.z.dtype}, expected float64")
    lead = tuple(log.z.shape[1:-1])
    rows = {"z": log.z, "dt": job.intervals, **log.inputs}
    if objective is not None:
        rows["time"] = log.time
        if log.truth is not None:
            rows["truth"] = log.truth
    return lead, {name: _broadcast(value, log.steps, lead) for name, value in rows.items()}


def _broadcast(x: Tensor, steps: int, lead: tuple[int, ...]) -> Tensor:
    """(T,), shared by all trajectories, as (T, *lead); others over their leading dimensions."""
    x = x.detach().to(torch.float64)
    if x.dim() == 1:
        x = x.reshape(-1, *[1] * len(lead))
    return x.expand(steps, *lead, *x.shape[1 + len(lead) :])


def _arguments(
    step: Compiled, job: Job, rows: Mapping[str, Tensor], lead: tuple[int, ...]
) -> list[Any]:
    """What both compiled functions begin with; the arrays live as long as the list."""
    state = {"mean": job.start.mean, "deviations": job.start.deviations, **job.start.memory}
    packed = [step.constants.pack(job.constants, ()), step.state.pack(state, lead)]
    flat = [_flat(rows[name], len(lead)) for name in step.row.shapes]
    pointers = (ctypes.c_void_p * len(flat))(*(x.data_ptr() for x in flat))
    along = (ctypes.c_long * len(flat))(*(x.stride(0) for x in flat))
    across = (ctypes.c_long * len(flat))(*(x.stride(1) for x in flat))
    pointers.keep = flat  # type: ignore[attr-defined]
    size = prod(lead)
    count = [ctypes.c_long(job.log.steps), ctypes.c_long(size)]
    return [*count, *(_pointer(x) for x in packed), pointers, along, across]


def _flat(x: Tensor, lead: int) -> Tensor:
    """(T, B, ...) with the numbers of a row side by side; no copy of plain or shared rows."""
    x = x.unsqueeze(1) if lead == 0 else x.flatten(1, lead) if lead > 1 else x
    return x if x[0, 0].is_contiguous() else x.contiguous()


def _pointer(x: Tensor) -> ctypes.c_void_p:
    found = ctypes.c_void_p(x.data_ptr())
    found.keep = x  # type: ignore[attr-defined]
    return found


def _places(layout: Layout, names: Sequence[str] | frozenset[str]) -> set[int]:
    """Places of named tensors in a packed row."""
    found: set[int] = set()
    at = 0
    for name, shape in layout.shapes.items():
        count = layout.count(shape)
        if name in names:
            found |= set(range(at, at + count))
        at += count
    return found
