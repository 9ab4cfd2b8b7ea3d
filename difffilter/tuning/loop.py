"""Tune the recipe of a scenario or a model, freeze it, and compare it on held-out data.

The gradient sees the soft weights at a falling temperature; the values that are kept are those
whose frozen, hard form is best on the validation data (the published ones, if nothing beats
them there). Started by ``torchrun``, each process runs its share of the trajectories; the first
one alone writes files and compares.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from difffilter.comparison.comparison import Comparison, compare
from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.scenario.case import Case
from difffilter.scenario.checkpoint import Checkpoint, save
from difffilter.scenario.model import Model, Simulator, as_case
from difffilter.scenario.settings import TuneSettings
from difffilter.scenario.sources import Logs, as_log
from difffilter.tuning.board import Board
from difffilter.tuning.descent import descend
from difffilter.tuning.history import Course, Entry
from difffilter.tuning.processes import ranks
from difffilter.tuning.select import with_tuned
from difffilter.tuning.state import only_run, state_path
from difffilter.tuning.task import Task

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
    history: tuple[Entry, ...]
    held_out: Comparison | None
    first: bool = True


def tune(
    case: Case | Recipe,
    train: Logs | Simulator | None = None,
    *,
    validation: Logs | None = None,
    test: Logs | None = None,
    tuned: Sequence[str] | None = None,
    loss: Mapping[str, float] | None = None,
    settings: Mapping[str, Any] | TuneSettings | None = None,
    seed: int = 0,
    out: str | Path | None = None,
    tensorboard: str | Path | None = None,
    resume: bool = False,
    progress: bool = False,
    engine: str = "auto",
) -> TuneResult:
    """Tune a filter's parameters by gradient, freeze them and compare on held-out data.

    How values are chosen: see :mod:`difffilter.tuning.loop`.

    Args:
        case: a scenario, a model, or a filter by itself.
        train: logs to train on: a :class:`Log`, a file, a list of either, or a function
            ``simulate(seed, count)``; without, trajectories that the case simulates.
        validation: logs that choose among the steps; without, a part of ``train`` is held back.
        test: logs to compare on; simulated trajectories where they can be drawn.
        tuned: names or patterns of the parameters to tune, in place of those declared so.
        loss: weight of each loss; settings: a whole TuneSettings or some fields; both over
            the case's own.
        seed: of everything random; same seed, same machine, same result.
        out: where to write the checkpoint; its resumable state stands beside it.
        tensorboard: folder for TensorBoard's files; progress: show a bar after two seconds.
        resume: go on from the state beside ``out``; the result is as if uninterrupted.
        engine: ``torch``, ``fused`` or ``auto``, as for :func:`difffilter.run`.

    Raises:
        InputError: nothing to tune, a loss without its truth, resume without ``out``, another
            run that writes ``out``; CheckpointError: a state that is damaged or of another run.
        NonFiniteError: a belief or a gradient turned non-finite; names where.
    """
    case, logs = _sources(as_case(case), train)
    case = _with_settings(case, settings, loss)
    case = case if tuned is None else with_tuned(case, tuned)
    recipe = _tunable(case)
    given = {"train": logs, "validation": validation, "test": test}
    read = {name: None if x is None else as_log(case, x) for name, x in given.items()}
    among = ranks()
    with only_run(state_path(out)) if out is not None and among.first else nullcontext():
        task = Task(
            case, recipe, case.tuning, seed=seed, train=read["train"],
            validation=read["validation"], asked=engine, ranks=among,
        )  # fmt: skip
        course, training = _search(task, out, tensorboard, resume, progress)
        among.meet()
        checkpoint = Checkpoint(case, case.tuning.system, course.best.values, None, training)
        if not among.first:
            return TuneResult(checkpoint, course.entries, None, first=False)
        return _compared(checkpoint, course, read["test"], task, out, progress)


def _compared(
    checkpoint: Checkpoint,
    course: Course,
    test: Log | None,
    task: Task,
    out: str | Path | None,
    progress: bool,
) -> TuneResult:
    """The result with its held-out comparison, written to ``out``."""
    if out is not None:  # before the comparison: what was tuned is not lost if that fails
        save(checkpoint, out)
    held_out = _held_out(checkpoint, task.seed, test, progress, task.asked)
    if held_out is not None:
        checkpoint = replace(checkpoint, result=held_out.as_dict())
    if out is not None:
        save(checkpoint, out)
        state_path(out).unlink(missing_ok=True)
    return TuneResult(checkpoint, course.entries, held_out)


def _search(
    task: Task,
    out: str | Path | None,
    tensorboard: str | Path | None,
    resume: bool,
    progress: bool,
) -> tuple[Course, dict[str, Any]]:
    """All steps, and what the checkpoint tells of them."""
    board = Board(tensorboard if task.ranks.first else None)
    try:
        state = None if out is None else state_path(out)
        course = descend(task, state, resume, board, progress)
    finally:
        board.close()
    settings, best = task.settings, course.best
    guards: dict[str, Any] = {}
    if "worlds" in settings.loss:
        held = task.held_to_guards(best.values)
        guards = {"guards": {"share": held.share, "worst": held.worst, "upper": held.upper}}
        best = best._replace(values=held.values)
    drawn = f"{settings.trajectories} simulated"
    training = {
        "loss": dict(settings.loss),
        "seed": task.seed,
        "engine": task.engine,
        "optimiser": task.optimiser,
        "settings": json.loads(json.dumps(asdict(settings))),
        "data": drawn if task.train is None else list(task.train.names),
        "validation_loss": best.loss,
        "validation_loss_published": course.entries[0].validation,
        "step": best.step,
        "start": best.start,
        "end": course.end,
        **guards,
    }
    if task.check.told:
        training["validation"] = task.check.told
    known = task.certainty(best.values, course.end in ("steps", "runs"))
    if known is not None:
        training["standard_errors"] = known.errors
        training["undetermined"] = list(known.free)
    return course._replace(best=best), training


def _sources(case: Case, train: Logs | Simulator | None) -> tuple[Case, Logs | None]:
    """The case, with a function that draws logs as its own; logs to train on."""
    if train is None or isinstance(train, (Log, str, Path)) or not callable(train):
        return case, train
    if not isinstance(case, Model):
        raise InputError(f"train: found a function, expected logs: {case.name} simulates by itself")
    return replace(case, simulate=train), None


def _tunable(case: Case) -> Recipe:
    name = case.tuning.system
    system = case.system(name)
    if not isinstance(system, Recipe):
        raise InputError(f"tune: system {name} is a baseline, expected a filter")
    if not any(p.tuned for p in system.declarations.values()):
        raise InputError(
            f"tune: no parameter of {name} has tuned = true, expected one or more (--tuned NAME, "
            f"or tuned=[...]) among {', '.join(system.declarations)}"
        )
    return system


def _with_settings(
    case: Case,
    settings: Mapping[str, Any] | TuneSettings | None,
    loss: Mapping[str, float] | None,
) -> Case:
    """The case with other ``[tuning]``, checked like its file and stored with the values."""
    if isinstance(settings, TuneSettings):
        settings = asdict(settings)
    changed = dict(settings or {}) | ({} if loss is None else {"loss": dict(loss)})
    plain = json.loads(json.dumps(changed))  # tuples to lists, as TOML has them
    return case.with_overrides({f"tuning.{name}": value for name, value in plain.items()})


def _held_out(
    checkpoint: Checkpoint, seed: int, test: Log | None, progress: bool, engine: str
) -> Comparison | None:
    case = checkpoint.scenario
    if (test is None and case.world is None) or (test is not None and test.truth is None):
        return None
    told = [name for name, spec in case.systems.items() if spec.clairvoyant and test is None]
    return compare(
        case,
        {"published": None, "tuned": checkpoint},
        case.tuning.test,
        seed,
        log=test,
        systems=tuple(dict.fromkeys([case.tuning.system, *told])),
        progress=progress,
        engine=engine,
    )
