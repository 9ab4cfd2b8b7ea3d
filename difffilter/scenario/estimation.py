"""Run any system, filter or baseline, over a log, from the right start."""

from __future__ import annotations

from dataclasses import replace

import torch

from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.scenario.build import System
from difffilter.scenario.case import Case
from difffilter.scenario.model import Model
from difffilter.scenario.scenario import Scenario
from difffilter.sensors.position import PositionSensor
from difffilter.sensors.wrapped import bare
from difffilter.start.bearings import from_bearings
from difffilter.start.known import at_position, from_truth
from difffilter.start.measurements import from_measurements

__all__ = ["estimate", "lean", "started"]


def lean(filter: Recipe, log: Log) -> Recipe:
    """The filter without local ones where that changes nothing: nothing can be isolated.

    Built-in sensors and measurements whose squares are finite; else the filter as it is.
    """
    built_in = all(isinstance(bare(sensor), PositionSensor) for sensor in filter.sensors)
    tame = bool((torch.nan_to_num(log.z).abs() < 1e100).all())
    return filter.centralised if built_in and tame else filter


def started(scenario: Case, system: System, log: Log, values: Values | None = None) -> Log:
    """The log with a start: its own, else the one that the scenario's ``[start]`` says.

    ``bearings`` crosses the first bearings; in a simulated world the start is then one time
    step before the first row, at step 0. ``given``: position, velocity, covariance and time as
    they stand there. ``truth`` of a scenario of recorded logs: the first row's. Else from the
    first measurements (also recorded logs of a simulated world's scenario).

    Args:
        scenario: its ``[start]`` says how; a model by itself.
        system: a filter or a baseline; the log keeps its channels.
        log: z (T, m) or (T, B, m).
        values: of the system's parameters, the published ones if missing.

    Raises:
        InputError: a trajectory, named, whose first measurements determine no position.
    """
    log = log.only(system.channels)
    if isinstance(scenario, Model):
        return scenario.started(log, values)
    if log.start is not None:
        return log
    assert isinstance(scenario, Scenario)
    return replace(log, start=_start(scenario, system, log, values))


def _start(scenario: Scenario, system: System, log: Log, values: Values | None) -> Start:
    spec = scenario.start
    if spec.kind == "given":
        assert spec.position is not None
        known = (spec.position, spec.velocity, spec.covariance, spec.time)
        return at_position(system.bare_states, *known, dtype=log.z.dtype)
    if spec.kind == "truth" and scenario.world is None:
        sigmas = {"position_sigma": spec.position_sigma, "velocity_sigma": spec.velocity_sigma}
        return from_truth(system.bare_states, log, **sigmas, span=spec.span)
    if spec.kind == "bearings":
        assert spec.velocity is not None
        lead = scenario.world.dt if scenario.world else 0.0
        return from_bearings(
            system, log, spec.velocity, values, rows=spec.rows, lead=lead, sensors=spec.sensors
        )
    return from_measurements(
        system,
        log,
        values,
        rows=spec.rows,
        span=spec.span,
        velocity_sigma=spec.unknown_velocity,
        velocity=spec.velocity,
        sensors=spec.sensors,
    )


def estimate(
    system: System,
    log: Log,
    values: Values | None = None,
    start: Start | None = None,
    *,
    temperature: float | None = None,
    progress: bool = False,
    engine: str = "auto",
) -> Track:
    """Estimates of a filter or a baseline over a log (see :func:`difffilter.run`).

    Args:
        system: a :class:`Filter`, or a baseline.
        log: z (T, m) or (T, B, m); further channels than the system's are left out.
        values: physical parameter values; the declared ones if missing.
        start: as for :func:`difffilter.run`; baselines may need none.
        temperature: of a filter's soft form; None for the hard form.
        progress: show a bar if it takes over two seconds.
        engine: of a filter: ``torch``, ``fused`` or ``auto``.

    Returns:
        Means (T, ..., n) and deviations; NaN where a baseline has no estimate.

    Raises:
        InputError: a channel that the log has not, shapes or values that do not fit, no start.
        NonFiniteError: names the first trajectory, step and state or channel.
    """
    log = log.only(system.channels)
    if isinstance(system, Recipe):
        return run(
            system, log, values, start, temperature=temperature, progress=progress, engine=engine
        )
    return system.estimate(log, values, start, progress=progress)
