"""Compiled steps by recipe and shapes: from memory, from the cache on disk, or made."""

from __future__ import annotations

import ctypes
import json
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from torch import Tensor

from difffilter.core.beliefs import Belief
from difffilter.engine.build import build, known, note
from difffilter.engine.fingerprint import fingerprint
from difffilter.engine.trace import Layout, Objective, Traced, trace
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Rows
from difffilter.parameters.values import Constants
from difffilter.scoring.losses import LOSSES

__all__ = ["Compiled", "Job", "Kind", "compiled"]

#: Traced and compiled steps that are kept in memory.
MOST = 64
#: Which function of a step: its name and what else its source depends on.
Kind = tuple[str, *tuple[object, ...]]


class Job(NamedTuple):
    """What a compiled step runs on.

    Attributes:
        filter, constants: as for :func:`difffilter.step`.
        log: rows, z (T, m) or (T, ..., m).
        start: fitted to the trajectories.
        intervals: dt before each row, (T,) or (T, ...).
    """

    filter: Recipe
    constants: Constants
    log: Rows
    start: Belief
    intervals: Tensor


class Compiled(NamedTuple):
    """A library, and how what it reads and writes is laid out.

    Attributes:
        library: the loaded functions.
        constants, state, row, output: see :class:`Traced`.
        sums: how many sums each loss has.
        kept: numbers that are computed once of the constants, at most.
    """

    library: ctypes.CDLL
    constants: Layout
    state: Layout
    row: Layout
    output: Layout
    sums: tuple[int, ...]
    kept: int


# The filter is kept so that its id stays its own.
_MADE: OrderedDict[tuple[object, ...], tuple[Recipe, Compiled]] = OrderedDict()
_TRACED: OrderedDict[tuple[object, ...], tuple[Recipe, Traced]] = OrderedDict()


def compiled(
    job: Job,
    rows: Mapping[str, Tensor],
    lead: int,
    kind: Kind,
    write: Callable[[Traced], str],
    objective: Objective | None = None,
) -> Compiled:
    """The compiled step of a job.

    Args:
        rows: by name, (T, *lead, ...); lead: how many dimensions trajectories have.
        kind: of the source that ``write`` makes of the traced step.

    Raises:
        EngineError: an operation without a rule; no compiler, or one that fails.
    """
    losses = tuple(LOSSES[name] for name in objective.losses) if objective else ()
    traced_key = (id(job.filter), _shapes(job, rows, lead), objective, losses)
    key = (*traced_key, kind)
    found = _MADE.get(key)
    if found is None:
        made = _compiled(
            job, rows, lead, kind, write=write, objective=objective, traced_key=traced_key
        )
        found = job.filter, made
        _keep(_MADE, key, found)
    else:
        _MADE.move_to_end(key)
    return found[1]


def _compiled(
    job: Job,
    rows: Mapping[str, Tensor],
    lead: int,
    kind: Kind,
    write: Callable[[Traced], str],
    objective: Objective | None,
    traced_key: tuple[object, ...],
) -> Compiled:
    """From the cache on disk, else traced, written and built."""
    name = None
    if traced_key not in _TRACED:
        name = fingerprint(job.filter, traced_key[1:], kind)
        found = None if name is None else _remembered(name)
        if found is not None:
            return found
        _keep(_TRACED, traced_key, (job.filter, _trace(job, rows, lead, objective)))
    _TRACED.move_to_end(traced_key)
    traced = _TRACED[traced_key][1]
    source = write(traced)
    made = Compiled(
        library=build(source),
        constants=traced.constants,
        state=traced.state,
        row=traced.row,
        output=traced.output,
        sums=tuple(map(len, traced.sums)),
        kept=max(traced.program.size, 1),
    )
    name = name or fingerprint(job.filter, traced_key[1:], kind)
    if name is not None:
        layouts = [list(layout.shapes.items()) for layout in made[1:5]]
        note(name, json.dumps({"layouts": layouts, "sums": made.sums, "kept": made.kept}), source)
    return made


def _remembered(name: str) -> Compiled | None:
    """What the cache on disk has under a fingerprint."""
    found = known(name)
    if found is None:
        return None
    text, library = found
    try:
        said = json.loads(text)
        layouts = [Layout({str(n): tuple(map(int, s)) for n, s in x}) for x in said["layouts"]]
        constants, state, row, output = layouts
        sums, kept = tuple(map(int, said["sums"])), int(said["kept"])
    except (ValueError, TypeError, KeyError):
        return None
    return Compiled(
        library=library,
        constants=constants,
        state=state,
        row=row,
        output=output,
        sums=sums,
        kept=kept,
    )


def _trace(job: Job, rows: Mapping[str, Tensor], lead: int, objective: Objective | None) -> Traced:
    start = job.start
    one = Belief(
        _single(start.mean, lead),
        _single(start.deviations, lead),
        {name: _single(value, lead) for name, value in start.memory.items()},
    )
    row = {
        name: _single(value, 1 + lead) for name, value in rows.items() if name not in ("z", "dt")
    }
    return trace(job.filter, job.constants, one, row, objective)


def _shapes(job: Job, rows: Mapping[str, Tensor], lead: int) -> tuple[object, ...]:
    """Names and shapes of all that a step reads; their numbers do not count."""
    start = job.start
    parts: Sequence[tuple[Mapping[str, Tensor], int]]
    parts = ((dict(job.constants), 0), (start.memory, lead), (rows, 1 + lead))
    shapes = tuple((name, *x.shape[first:]) for part, first in parts for name, x in part.items())
    return (*shapes, tuple(start.deviations.shape[lead:]))


def _keep(kept: OrderedDict[Any, Any], key: object, made: object) -> None:
    kept[key] = made
    if len(kept) > MOST:
        kept.popitem(last=False)


def _single(x: Tensor, first: int) -> Tensor:
    return x[(0,) * first].clone()
