"""Logs from whatever holds them: logs, files, lists of either."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from difffilter.errors import InputError
from difffilter.logs.log import Log, stack_logs
from difffilter.logs.logfile import read_log
from difffilter.scenario.case import Case
from difffilter.scenario.recorded import load_logs
from difffilter.scenario.scenario import Scenario

__all__ = ["Logs", "as_log"]

#: One log (a batch or a single one), a file, or several of either.
Logs = Log | str | Path | Sequence[Log | str | Path]


def as_log(case: Case, source: Logs) -> Log:
    """One batch of logs (T, B, m), files read as the case says.

    Raises:
        LogError: a file that does not fit; InputError: something else than logs or files,
            logs that do not fit beside each other.
    """
    several = isinstance(source, Sequence) and not isinstance(source, str)
    parts = list(source) if several else [source]  # type: ignore[arg-type]
    if not parts:
        raise InputError("logs: found none, expected at least one")
    paths = [part for part in parts if isinstance(part, (str, Path))]
    if isinstance(case, Scenario) and len(paths) == len(parts):
        return load_logs(case, paths)
    logs = [_one(case, part) for part in parts]
    if len(logs) == 1:
        return _batched(logs[0])
    singles = [one for log in logs for one in _singles(log)]
    starts = [one.start for one in singles]
    stacked = stack_logs(singles)
    if any(start is not None for start in starts):
        raise InputError("logs: found several with a start of their own, expected one batch")
    return stacked


def _one(case: Case, part: object) -> Log:
    if isinstance(part, Log):
        return part
    if not isinstance(part, (str, Path)):
        raise InputError(f"logs: found {type(part).__name__}, expected a Log or a file")
    if isinstance(case, Scenario):
        return load_logs(case, [part])
    return read_log(part, case.system().channels, case.inputs)


def _batched(log: Log) -> Log:
    """A log with the dimension of trajectories."""
    if log.z.dim() > 2:
        return log
    if log.start is None:
        return stack_logs([log])
    start = log.start
    covariance = None if start.covariance is None else start.covariance[None]
    made = stack_logs([replace(log, start=None)])
    return replace(made, start=replace(start, mean=start.mean[None], covariance=covariance))


def _singles(log: Log) -> list[Log]:
    """The trajectories of a log, one by one."""
    if log.z.dim() < 3:
        return [log]
    return [log.alone(i) for i in range(log.trajectories)]
