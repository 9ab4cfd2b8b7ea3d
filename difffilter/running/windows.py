"""A filter over a long log in windows of rows: memory that does not grow with the log."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from tqdm import tqdm

from difffilter.engine.choice import eager_seconds, pick, tell
from difffilter.errors import EngineError, InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.running.batch import check_finite, eager, prepared

__all__ = ["WINDOW", "run_windows"]

#: Rows of a window.
WINDOW = 500_000


def run_windows(
    filter: Recipe,
    log: Log,
    values: Values | None = None,
    start: Start | None = None,
    *,
    temperature: float | None = None,
    rows: int = WINDOW,
    progress: bool = False,
    engine: str = "auto",
) -> Iterator[tuple[Log, Track]]:
    """The windows of a log, each with its estimates: together those of :func:`difffilter.run`.

    The belief is carried over from one window to the next, with its memory.

    Args:
        rows: of a window; others as for :func:`difffilter.run`.

    Raises:
        InputError, NonFiniteError: as for :func:`difffilter.run`, when their window is reached.
    """
    if rows < 1:
        raise InputError(f"rows: found {rows}, expected 1 or more")
    with torch.no_grad():
        constants, current, intervals = prepared(filter, log, values, start, temperature)
        chosen = pick(engine, eager_seconds(log))
        firsts = range(0, log.steps, rows)
        bar = tqdm(firsts, desc="filter", unit="window", delay=2.0, disable=not progress)
        for first in bar:
            part, dt = log.rows(first, first + rows), intervals[first : first + rows]
            track = None
            if chosen != "torch":
                from difffilter.engine.fused import Job, forward

                try:
                    found = forward(Job(filter, constants, part, current, dt))
                    track = filter.track(part.time, *found)
                except EngineError as error:
                    if chosen == "fused":
                        raise
                    tell(error)
                    chosen = "torch"
            if track is None:
                track = eager(filter, constants, part, current, dt)
            check_finite(track, first)
            assert track.final is not None
            current = track.final
            yield part, track
