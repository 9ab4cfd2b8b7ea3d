"""Tune a system of a scenario, freeze it, and compare it on held-out data."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from difffilter.comparison.comparison import Comparison, compare
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log
from difffilter.scenario.checkpoint import Checkpoint, save
from difffilter.scenario.scenario import Scenario
from difffilter.scenario.settings import TuneSettings
from difffilter.tuning.board import Board
from difffilter.tuning.descent import Descent
from difffilter.tuning.processes import ranks
from difffilter.tuning.state import state_path

__all__ = ["TuneResult", "tune"]


@dataclass(frozen=True)
class TuneResult:
    """What tuning gave.

    Attributes:
        checkpoint: the frozen values.
        history: one entry per validation: start, step, training and validation loss, values.
        held_out: published, tuned and clairvoyant on the same test trajectories; None where
            there is nothing with truth to test on.
        first: whether this is the only process, or the first of several: that which writes.
    """

    checkpoint: Checkpoint
    history: list[dict[str, Any]]
    held_out: Comparison | None
    first: bool = True


def tune(
    scenario: Scenario,
    *,
    seed: int = 0,
    log: Log | None = None,
    test: Log | None = None,
    settings: Mapping[str, Any] | TuneSettings | None = None,
    out: str | Path | None = None,
    tensorboard: str | Path | None = None,
    resume: bool = False,
    progress: bool = False,
    engine: str = "auto",
) -> TuneResult:
    """Tune a system's parameters by gradient, freeze them and compare on held-out data.

    Started by ``torchrun``, each process runs its share of the trajectories; the first one
    alone writes files and compares.

    The gradient sees the soft weights at a falling temperature; the values that are kept
    are those whose frozen, hard form is best on the validation data (the published ones, if
    nothing beats them there).

    Args:
        scenario: names the system, the parameters to tune, the loss.
        seed: of everything random; same seed, same machine, same result.
        log: recorded logs to train on (windows with warm starts) in place of simulated
            trajectories. They also validate: whole runs of the frozen form.
        test: recorded logs to test on; simulated trajectories where there is a world.
        settings: a whole TuneSettings, or some of its fields, over the scenario's own.
        out: where to write the checkpoint; its resumable state stands beside it.
        tensorboard: folder for TensorBoard's files.
        resume: go on from the state beside ``out``; the result is as if uninterrupted.
        engine: ``torch``, ``fused`` or ``auto``, as for :func:`difffilter.run`.

    Raises:
        InputError: nothing to tune, a loss that needs truth without truth, resume without
            ``out``; CheckpointError: a state that is damaged or of another run.
        NonFiniteError: a belief or a gradient turned non-finite; names where.
    """
    scenario = _with_settings(scenario, settings)
    chosen = scenario.tuning
    system = scenario.system(chosen.system)
    if not isinstance(system, Filter):
        raise InputError(f"tune: system {chosen.system} is a baseline, expected a filter")
    if not any(p.tuned for p in system.declarations.values()):
        raise InputError(f"tune: no parameter of {chosen.system} has tuned = true")
    among = ranks()
    job = Descent(scenario, system, chosen, seed, log, engine, among)
    board = Board(tensorboard if among.first else None)
    try:
        best, history = job.search(
            None if out is None else state_path(out), resume, board, progress
        )
    finally:
        board.close()
    training = {
        "loss": dict(chosen.loss),
        "seed": seed,
        "engine": job.engine,
        "optimiser": job.optimiser,
        "settings": json.loads(json.dumps(asdict(chosen))),
        "data": list(log.names) if log is not None else f"{chosen.trajectories} simulated",
        "validation_loss": best["loss"],
        "validation_loss_published": history[0]["validation"],
        "step": best["step"],
        "start": best["start"],
    }
    known = job.certainty(best["values"])
    if known is not None:
        training["standard_errors"] = known.errors
        training["undetermined"] = list(known.free)
    checkpoint = Checkpoint(scenario, chosen.system, best["values"], None, training)
    if not among.first:
        return TuneResult(checkpoint, history, None, first=False)
    if out is not None:  # before the comparison: what was tuned is not lost if that fails
        save(checkpoint, out)
    held_out = _held_out(checkpoint, chosen, seed, test, progress, engine)
    if held_out is not None:
        checkpoint = replace(checkpoint, result=held_out.as_dict())
    if out is not None:
        save(checkpoint, out)
        state_path(out).unlink(missing_ok=True)
    return TuneResult(checkpoint, history, held_out)


def _with_settings(
    scenario: Scenario, settings: Mapping[str, Any] | TuneSettings | None
) -> Scenario:
    """The scenario with other ``[tuning]``, checked like its file and stored with the values."""
    if isinstance(settings, TuneSettings):
        settings = asdict(settings)
    plain = json.loads(json.dumps(dict(settings or {})))  # tuples to lists, as TOML has them
    return scenario.with_overrides({f"tuning.{name}": value for name, value in plain.items()})


def _held_out(
    checkpoint: Checkpoint,
    settings: TuneSettings,
    seed: int,
    test: Log | None,
    progress: bool,
    engine: str,
) -> Comparison | None:
    scenario = checkpoint.scenario
    told = [name for name, spec in scenario.systems.items() if spec.clairvoyant and test is None]
    systems = tuple(dict.fromkeys([settings.system, *told]))
    if test is None and scenario.world is None:
        return None
    if test is not None and test.truth is None:
        return None
    return compare(
        scenario,
        {"published": None, "tuned": checkpoint},
        settings.test,
        seed,
        log=test,
        systems=systems,
        progress=progress,
        engine=engine,
    )
