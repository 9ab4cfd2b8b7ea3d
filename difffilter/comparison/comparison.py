"""Systems and sets of values on the same held-out trajectories."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import NamedTuple

import torch
from tqdm import tqdm

from difffilter.comparison.table import Comparison, Row, tabulate
from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.family import Starter
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.running.smoothing import check_smoothable, smoothed
from difffilter.scenario.build import System
from difffilter.scenario.case import Case
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scenario.estimation import estimate, started
from difffilter.scenario.model import as_case
from difffilter.scenario.simulation import simulate
from difffilter.scenario.sources import Logs, as_log

__all__ = [
    "TOLD",
    "Comparison",
    "Contestant",
    "Row",
    "compare",
    "contestants",
    "resolved",
    "run_all",
    "told_by",
    "unsmoothable",
]

#: Stands for the systems of a scenario that are told of every fault.
TOLD = "told"


class Contestant(NamedTuple):
    """Who runs in a comparison.

    Attributes:
        system, values: names of both, for the table.
        recipe: a filter or a baseline.
        frozen: physical values; None for the published ones.
        temperature: None for the hard form.
    """

    system: str
    values: str
    recipe: System
    frozen: Values | None = None
    temperature: float | None = None


def compare(
    scenario: Case | Recipe,
    values: Mapping[str, Checkpoint | None] | None = None,
    trajectories: int = 200,
    seed: int = 1,
    *,
    log: Logs | None = None,
    systems: tuple[str, ...] = (),
    progress: bool = False,
    engine: str = "auto",
    smooth: bool = False,
) -> Comparison:
    """Run every system with published values, and every checkpoint's system with its own.

    Args:
        scenario: the world, or recorded logs' geometry.
        values: label to checkpoint; None (conventionally ``published``) runs every system
            with its published values. Default: published alone. Where ``systems`` leaves out
            a checkpoint's own, its values run those of them that are told of every fault.
        trajectories, seed: of the simulated held-out trajectories, disjoint from training
            and validation whatever the seed.
        log: recorded logs in place of simulated ones.
        systems: only these; all if empty. ``told``: those that are told of every fault.
        engine: of the filters, as for :func:`difffilter.run`.
        smooth: a row ``SYSTEM smoothed`` beside each system that :func:`difffilter.smooth`
            takes, from its whole log.

    Raises:
        InputError: a checkpoint of a system or with parameters that this scenario has not,
            a log without truth; with ``smooth`` no system that can be smoothed.
    """
    scenario = as_case(scenario)
    systems = resolved(scenario, systems)
    chosen = contestants(scenario, {"published": None} if values is None else values, systems)
    held_out = (
        simulate(scenario, trajectories, seed, "test") if log is None else as_log(scenario, log)
    )
    if held_out.truth is None:
        raise InputError(
            "compare: needs truth columns in the logs, found none; compare_without_truth asks "
            "what each filter foretells"
        )
    if smooth and not any(unsmoothable(one.recipe) == "" for one in chosen):
        raise InputError(unsmoothable(chosen[0].recipe))
    return tabulate(
        scenario.name,
        run_all(chosen, held_out, partial(started, scenario), engine, progress, smooth=smooth),
        held_out,
        wanted=(scenario.tuning.system, "published"),
        seed=seed if log is None else None,
        score=scenario.score,
        scenes=scenario.scenes,
    )


def run_all(
    who: Sequence[Contestant],
    log: Log,
    starter: Starter,
    engine: str,
    progress: bool = False,
    *,
    smooth: bool = False,
) -> dict[tuple[str, str], Track]:
    """Everybody's track of one log, by system and values; smoothed ones beside, if wanted.

    Raises:
        InputError: names those that cannot start, and who remains without them.
    """
    tracks = {}
    starts: list[Log] = []
    unable: dict[str, InputError] = {}
    for one in who:
        try:
            starts.append(starter(one.recipe, log, one.frozen))
        except InputError as error:
            unable.setdefault(one.system, error)
    if unable:
        raise _cannot_start(who, unable)
    bar = tqdm(who, desc="compare", unit="system", delay=2.0, disable=not progress)
    for one, ready in zip(bar, starts, strict=True):
        with torch.no_grad():
            tracks[one.system, one.values] = estimate(
                one.recipe, ready, one.frozen, temperature=one.temperature, engine=engine
            )
            if smooth and unsmoothable(one.recipe) == "":
                tracks[f"{one.system} smoothed", one.values] = smoothed(
                    check_smoothable(one.recipe),
                    ready.only(one.recipe.channels),
                    tracks[one.system, one.values],
                    one.frozen,
                    temperature=one.temperature,
                )
    return tracks


def _cannot_start(who: Sequence[Contestant], unable: Mapping[str, InputError]) -> InputError:
    """One error for all that cannot start: who, why the first of them, and who remains."""
    name, reason = next(iter(unable.items()))
    rest = dict.fromkeys(one.system for one in who if one.system not in unable)
    also = f" (nor can {', '.join(list(unable)[1:])})" if len(unable) > 1 else ""
    how = " ".join(f"--system {other}" for other in rest)
    advice = f"; the others compare with {how}" if rest else ""
    return InputError(f"system {name} cannot start{also}: {reason}{advice}")


def unsmoothable(system: System) -> str:
    """Why a system cannot be smoothed; empty where it can."""
    try:
        check_smoothable(system)
    except InputError as error:
        return str(error)
    return ""


def resolved(scenario: Case, systems: Sequence[str]) -> tuple[str, ...]:
    """The names, and for ``told`` those of the systems that are told of every fault.

    Raises:
        InputError: ``told`` of a scenario without such a system.
    """
    if TOLD not in systems or TOLD in scenario.systems:
        return tuple(systems)
    told = [name for name, spec in scenario.systems.items() if spec.clairvoyant]
    if not told:
        raise InputError(
            f"system told: {scenario.name} has none that is told of its faults, expected one of "
            f"{', '.join(scenario.systems)}"
        )
    named = [told if name == TOLD else [name] for name in systems]
    return tuple(dict.fromkeys(name for part in named for name in part))


def told_by(scenario: Case, systems: Sequence[str], checkpoint: Checkpoint) -> list[str]:
    """Those of the systems that are told of every fault and have no value but the checkpoint's."""
    found = []
    for name in systems:
        if scenario.systems[name].clairvoyant:
            system = scenario.system(name)
            if set(system.declarations) <= set(checkpoint.values):
                found.append(name)
    return found


def contestants(
    scenario: Case, values: Mapping[str, Checkpoint | None], systems: tuple[str, ...]
) -> list[Contestant]:
    """Every system with published values, and every checkpoint's system with its own.

    Raises:
        InputError: a checkpoint of a system or with parameters that the scenario has not.
    """
    for name in systems:
        scenario.system(name)
    chosen: list[Contestant] = []
    for label, checkpoint in values.items():
        if checkpoint is None:
            names = [name for name in scenario.systems if not systems or name in systems]
            chosen += [Contestant(name, label, scenario.system(name)) for name in names]
            continue
        recipe = scenario.system(checkpoint.system)
        declared = set(recipe.declarations)
        if declared != set(checkpoint.values):
            differing = ", ".join(sorted(declared ^ set(checkpoint.values)))
            raise InputError(
                f"values {label}: tuned for {checkpoint.scenario.name}, does not fit system "
                f"{checkpoint.system} of {scenario.name} (parameters {differing})"
            )
        names = [checkpoint.system]
        if systems and checkpoint.system not in systems:
            names = told_by(scenario, systems, checkpoint) or names
        for name in names:
            recipe = scenario.system(name)
            values_of = {n: checkpoint.values[n] for n in recipe.declarations}
            chosen.append(Contestant(name, label, recipe, values_of, checkpoint.temperature))
    if not chosen:
        raise InputError("values: found none, expected published or a checkpoint")
    return chosen
