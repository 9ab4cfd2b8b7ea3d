"""Recorded logs of a scenario: files to one batched log, with each run's own geometry."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import torch

from difffilter.errors import LogError
from difffilter.logs.log import Log, stack_logs
from difffilter.logs.logfile import read_log
from difffilter.motions.blocks import ConstantVelocity
from difffilter.scenario.pooling import pooled
from difffilter.scenario.scenario import Scenario
from difffilter.sensors.builtin import StationSensor

__all__ = ["load_logs", "scenario_of_run"]


def scenario_of_run(scenario: Scenario, run: str) -> Scenario:
    """The scenario with the overrides of ``[runs.RUN]``; itself where there are none."""
    if run not in scenario.runs:
        return scenario
    return scenario.with_overrides(scenario.runs[run])


def load_logs(scenario: Scenario, paths: Sequence[str | Path], run: str | None = None) -> Log:
    """Read log files and stack them; station positions become inputs, since runs differ.

    Args:
        scenario: names the channels, the input columns and, in ``[runs]``, what differs.
        paths: CSV files; the stem of each names its run.
        run: the run whose overrides apply to all files, in place of their stems.

    Returns:
        Log with z (T, B, m), padded to the longest, and inputs ``NAME.stations``
        (T, B, stations, coordinates) of every sensor with stations.

    Raises:
        LogError: a file that does not fit, with its line; InputError: other mismatches.
    """
    return stack_logs([_load(scenario, Path(path), run) for path in paths])


def _load(scenario: Scenario, path: Path, run: str | None) -> Log:
    own = scenario_of_run(scenario, run or path.stem)
    log = _read(own, path)
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
    return replace(log, inputs=inputs)


def _read(scenario: Scenario, path: Path) -> Log:
    """The log with every channel; pooled ones are computed where they have no column."""
    derived = [c for s in scenario.sensors.values() if s.pool for c in s.model.channels]
    try:
        with path.open(encoding="utf-8-sig") as file:
            header = {name.strip() for name in file.readline().split(",")}
    except (OSError, UnicodeDecodeError):
        header = set()  # read_log says what is wrong
    absent = [name for name in derived if name not in header]
    log = read_log(path, [c for c in scenario.channels if c not in absent], scenario.inputs)
    if not absent:
        return log
    z = torch.full((log.steps, len(scenario.channels)), torch.nan, dtype=log.z.dtype)
    z[:, [scenario.channels.index(name) for name in log.channels]] = log.z
    z, _ = pooled(scenario.sensors, scenario.channels, z)
    return replace(log, channels=scenario.channels, z=z)
