"""Run any system, filter or baseline, over a log, from the right start."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from difffilter.filter import Filter
from difffilter.log import Log, Start
from difffilter.parameters import Values
from difffilter.run import Track, run
from difffilter.start import from_measurements

if TYPE_CHECKING:
    from difffilter.scenario.scenario import Scenario
    from difffilter.scenario.systems import System

__all__ = ["estimate", "started"]


def started(scenario: Scenario, system: System, log: Log, values: Values | None = None) -> Log:
    """The log with a start: its own, else one from its first measurements.

    How many rows that reads, and how unknown the velocity is, the scenario's ``[start]``
    says; values are those of the system's parameters, the published ones if missing.
    """
    log = log.only(system.channels)
    if log.start is not None:
        return log
    spec = scenario.start
    start = from_measurements(
        system, log, values, rows=spec.rows, velocity_sigma=spec.unknown_velocity
    )
    return replace(log, start=start)


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
    log = log.only(system.channels)
    if isinstance(system, Filter):
        return run(system, log, values, start, temperature=temperature, progress=progress)
    return system.estimate(log, values, start, progress=progress)
