"""Recorded logs of a scenario: files to one batched log, with each run's own geometry."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from difffilter.errors import LogError
from difffilter.logs.layout import Bound, Form
from difffilter.logs.log import Log, stack_logs
from difffilter.logs.reading import Reading, reading
from difffilter.motions.blocks import ConstantVelocity
from difffilter.scenario.document import apply_overrides
from difffilter.scenario.plausibility import check_units
from difffilter.scenario.pooling import pooled
from difffilter.scenario.scenario import Scenario, read_scenario
from difffilter.sensors.builtin import Range, StationSensor

__all__ = ["bounds", "load_logs", "read_run", "scenario_of_run", "stacked"]

#: A whole turn in rad, and a hair.
TURN = math.tau * (1 + 1e-12)


def scenario_of_run(scenario: Scenario, run: str) -> Scenario:
    """The scenario with the overrides of ``[runs.RUN]``, without runs; itself without such."""
    if run not in scenario.runs:
        return scenario
    alone = {key: value for key, value in scenario.document.items() if key != "runs"}
    return read_scenario(apply_overrides(alone, scenario.runs[run]), scenario.path)


def load_logs(scenario: Scenario, paths: Sequence[str | Path], run: str | None = None) -> Log:
    """Read logs and stack them; station positions become inputs, since runs differ.

    Args:
        scenario: names the channels, the input columns and, in ``[runs]``, what differs;
            ``[log]`` says how the files are stored.
        paths: files; or, of a log in several files, what takes the place of ``{run}`` in
            their names. The stem of each names its run.
        run: the run whose overrides apply to all files, in place of their stems.

    Returns:
        Log with z (T, B, m), padded to the longest, and inputs ``NAME.stations``
        (T, B, stations, coordinates) of every sensor with stations.

    Raises:
        LogError: a file that does not fit, with its line; InputError: other mismatches.
    """
    return stacked(scenario, [read_run(scenario, path, run) for path in paths])


def stacked(scenario: Scenario, read: Sequence[Reading]) -> Log:
    """Logs as read as one batch, z (T, B, m); LogError where their units make no sense."""
    log = stack_logs([one.log for one in read])
    check_units(scenario, log, [one.sure for one in read])
    return log


def read_run(scenario: Scenario, path: str | Path, run: str | None = None) -> Reading:
    """One recorded log, z (T, m), how its times are written, and what was done to its rows.

    Arguments and errors as those of :func:`load_logs`.
    """
    path = Path(path)
    own = scenario_of_run(scenario, run or path.stem)
    derived = [c for s in own.sensors.values() if s.pool for c in s.model.channels]
    form = own.log or Form()
    read = reading(path, form, own.channels, own.inputs, bounds(own), derived)
    log = _with_pooled(own, read.log)
    known = ConstantVelocity(own.axes).states
    for name in log.truth_states:
        if name not in known:
            raise LogError(
                f"{path}, line 1: found column 'truth_{name}', "
                f"expected truth_<state> of {', '.join(known)}"
            )
    inputs = dict(log.inputs)
    for sensor in own.sensors.values():
        if isinstance(sensor.model, StationSensor):
            stations = torch.tensor(sensor.model.stations, dtype=log.z.dtype)
            inputs[f"{sensor.model.name}.stations"] = stations.expand(log.steps, -1, -1)
    return replace(read, log=replace(log, inputs=inputs))


def bounds(scenario: Scenario) -> dict[str, Bound]:
    """What each channel can be at all: a range is above 0, an angle within 2 pi."""
    found = {}
    for spec in scenario.sensors.values():
        for channel in spec.model.channels:
            if isinstance(spec.model, Range):
                found[channel] = Bound(0.0, math.inf, "a range above 0 m")
            elif spec.model.unit == "rad":
                found[channel] = Bound(-TURN, TURN, "an angle within 2 pi rad")
    return found


def _with_pooled(scenario: Scenario, log: Log) -> Log:
    """The log with every channel; pooled ones are computed where they have no column."""
    if log.channels == scenario.channels:
        return log
    z = torch.full((log.steps, len(scenario.channels)), torch.nan, dtype=log.z.dtype)
    z[:, [scenario.channels.index(name) for name in log.channels]] = log.z
    z, _ = pooled(scenario.sensors, scenario.channels, z)
    return replace(log, channels=scenario.channels, z=z)
