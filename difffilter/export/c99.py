"""``<name>.h``, ``<name>.c``, golden vectors and a self-test of a frozen filter."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import torch

from difffilter.core.beliefs import Belief
from difffilter.engine.trace import trace
from difffilter.errors import InputError
from difffilter.export import vectors
from difffilter.export.golden import USABLE, golden
from difffilter.export.header import header
from difffilter.export.origin import relative
from difffilter.export.program import identifier
from difffilter.export.source import read_places, source
from difffilter.export.templates import GOLDEN, HEADER, SOURCE, TEST
from difffilter.files import write_together
from difffilter.filters.recipe import Recipe
from difffilter.parameters.values import Constants
from difffilter.scenario.checkpoint import Checkpoint

__all__ = ["export_c"]


def export_c(
    checkpoint: Checkpoint,
    folder: str | Path,
    name: str | None = None,
    single: bool = False,
    *,
    origin: Sequence[float] = (),
) -> list[Path]:
    """Write the frozen filter as C99; the paths written.

    ``<name>.h`` and ``<name>.c``: the belief, its start, one step; no heap, no library but
    libm, no state of their own. ``<name>_golden.h`` and ``<name>_test.c``: a self-test against
    the torch filter.

    Args:
        folder: made if missing; name: of the files and the prefix of every symbol; the
            scenario's if None.
        single: whether it compiles in float by default, and with ``-D<NAME>_DOUBLE`` in
            double; else in double, and with ``-D<NAME>_FLOAT`` in float.
        origin: coordinates in m, one per axis, to which all positions are relative: a float
            has seven digits, too few for metres in a national grid.

    Raises:
        InputError: a filter that is told what no sensor tells (clairvoyant, ideal), an origin
            that does not fit, float for positions that it cannot tell apart, a place that
            cannot be written (nothing is written then); EngineError: an operation without a
            rule.
    """
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: found a file, expected a folder")
    filter = _deployable(checkpoint)
    if len(origin):
        filter = relative(filter, checkpoint.values, origin)
    name = identifier(name or checkpoint.scenario.name)
    files = _files(checkpoint, filter, name, single, origin)
    write_together(folder, files)
    return [folder / file for file in files]


def _deployable(checkpoint: Checkpoint) -> Recipe:
    filter = checkpoint.published_filter
    if filter.foretold:
        raise InputError(
            f"export: {checkpoint.system} is told of faults, expected a deployable one"
        )
    return filter


def _files(
    checkpoint: Checkpoint, filter: Recipe, name: str, single: bool, origin: Sequence[float]
) -> dict[str, str]:
    """Text of each file."""
    constants = filter.prepare(checkpoint.values, checkpoint.temperature)
    zero = torch.zeros((), dtype=torch.float64)
    n = len(filter.states)
    p = len(filter.error_states)
    begin = filter.start(torch.zeros(n).double(), torch.eye(p, dtype=torch.float64))
    known = _inputs(checkpoint, filter, constants, begin)
    step = trace(filter, constants, begin, dict.fromkeys(known, zero))
    made = golden(checkpoint, filter, known)
    usable = made.tolerance[1] <= USABLE
    if single and not usable:
        raise InputError(
            "export: float has too few digits for these positions, expected double, or an "
            "origin near the stations (--origin)"
        )
    words = {
        "name": name,
        "guard": name.upper(),
        "n": n,
        "p": p,
        "m": len(filter.channels),
        "other": "DOUBLE" if single else "FLOAT",
        "other_word": "double" if single else "float",
    }
    head = header(
        checkpoint, filter, step, known, name=name, single=single, usable=usable, origin=origin
    )
    return {
        f"{name}.h": HEADER.format(**words, **head),
        f"{name}.c": SOURCE.format(**words, **source(filter, constants, step, begin, name)),
        f"{name}_golden.h": GOLDEN.format(**words, **vectors.vectors(made, known, name)),
        f"{name}_test.c": TEST.format(**words, **vectors.test(known, name)),
    }


def _inputs(
    checkpoint: Checkpoint, filter: Recipe, constants: Constants, begin: Belief
) -> tuple[str, ...]:
    """Known inputs that a step reads: positions of platforms, columns that the scenario names."""
    possible = tuple(dict.fromkeys((*filter.inputs, *checkpoint.scenario.inputs)))
    one = torch.ones((), dtype=torch.float64)
    step = trace(filter, constants, begin, dict.fromkeys(possible, one))
    read = read_places(step, "r")
    at, found = 0, []
    for key, shape in step.row.shapes.items():
        count = step.row.count(shape)
        if key in possible and read & set(range(at, at + count)):
            found.append(key)
        at += count
    return tuple(found)
