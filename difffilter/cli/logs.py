"""Recorded logs on the command line."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from difffilter.cli.output import note
from difffilter.errors import InputError

if TYPE_CHECKING:
    from difffilter.logs.log import Log
    from difffilter.scenario.case import Case
    from difffilter.scenario.scenario import Scenario

__all__ = ["need_log", "not_clairvoyant", "note_missing_run", "read_logs"]


def read_logs(scenario: Case, paths: Sequence[str] | None) -> Log | None:
    """The logs as one batch, each with its own run's geometry; None where none are given."""
    from difffilter.scenario.recorded import read_run, stacked
    from difffilter.scenario.scenario import Scenario
    from difffilter.scenario.sources import as_log

    if not paths:
        return None
    if not isinstance(scenario, Scenario):
        return as_log(scenario, paths)
    read = [read_run(scenario, path) for path in paths]
    for path, one in zip(paths, read, strict=True):
        for line in one.told:
            note(line)
        note_missing_run(scenario, Path(path).stem)
    return stacked(scenario, read)


def note_missing_run(scenario: Scenario, run: str) -> None:
    """Say so where a scenario has [runs] and this log is none of them."""
    if scenario.runs and run not in scenario.runs:
        note(
            f"{scenario.name}: log {run!r} is none of the runs {', '.join(scenario.runs)}; "
            "no run's positions apply, but those of the scenario or of --set"
        )


def need_log(scenario: Case, log: Log | None) -> None:
    """Raise InputError for a scenario of recorded logs without logs."""
    if scenario.world is None and log is None:
        raise InputError(f"{scenario.name}: has no world to simulate, expected --log FILE ...")


def not_clairvoyant(scenario: Case, system: str) -> None:
    """Raise InputError for a system that must be told of faults, which no log records."""
    if scenario.systems[system].clairvoyant:
        raise InputError(
            f"system {system}: is told of every simulated fault, expected a system that "
            "works on recorded logs"
        )
