"""Run any system, filter or baseline, over a log, from the right start."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from difffilter.filter import Filter
from difffilter.log import Log, Start
from difffilter.parameters import Values
from difffilter.run import Track, run

if TYPE_CHECKING:
    from difffilter.scenario.systems import System

__all__ = ["estimate", "started"]


def started(system: System, log: Log, values: Values | None = None, rows: int = 10) -> Log:
    """The log with a start: its own, else one made from its first measurements."""
    if log.start is not None:
        return log
    from difffilter.start import from_measurements

    return replace(log, start=from_measurements(system, log, values, rows=rows))


def estimate(
    system: System,
    log: Log,
    values: Values | None = None,
    start: Start | None = None,
    *,
    temperature: float | None = None,
    progress: bool = False,
) -> Track:
    """Estimates of a filter or a baseline over a log (see :func:`difffilter.run`)."""
    if isinstance(system, Filter):
        return run(system, log, values, start, temperature=temperature, progress=progress)
    return system.estimate(log, values, start, progress=progress)
