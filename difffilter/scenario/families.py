"""A scenario's family: its own world and its ``[[worlds]]``, or recorded logs and groups."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.logs.family import Family, Member
from difffilter.logs.log import Log
from difffilter.scenario.estimation import started
from difffilter.scenario.scenario import Scenario
from difffilter.scenario.simulation import simulate
from difffilter.scenario.worlds import BASE, WorldSpec, changed
from difffilter.sensors.builtin import StationSensor

__all__ = ["family"]


def family(scenario: Scenario, log: Log | None = None) -> Family:
    """The scenario's own world and its ``[[worlds]]``; of recorded logs, those and groups of them.

    Every simulated member's logs hold the positions of stations as inputs where those of any
    member differ, so that one filter serves all.

    Args:
        log: recorded logs, whose names the entries' ``logs`` choose from; an entry that
            chooses none of them is left out. None for simulated worlds.

    Raises:
        InputError: a scenario without ``[world]`` and no log.

    Example:
        >>> from difffilter import family, load_scenario
        >>> next(iter(family(load_scenario("airport-mlat-intermittent")))).name
        'base'
    """
    if log is None and scenario.world is None:
        raise InputError(f"{scenario.name}: has no [world] to simulate, expected recorded logs")
    base = WorldSpec(
        name=BASE,
        where="",
        weight=1.0,
        role="tune",
        allow=1.02,
        plausible="",
        overrides={},
        logs=(),
    )
    given = {spec.name: spec for spec in scenario.worlds}
    specs = [given.pop(BASE, base), *given.values()]
    if log is not None:
        return Family(tuple(_recorded(scenario, spec, log) for spec in specs if _names(spec, log)))
    chosen = [spec for spec in specs if not spec.logs]
    worlds = [scenario if spec.name == BASE else changed(scenario, spec) for spec in chosen]
    own = _stations(scenario)
    told = [name for name in own if any(_stations(world)[name] != own[name] for world in worlds)]
    return Family(
        tuple(_simulated(spec, world, told) for spec, world in zip(chosen, worlds, strict=True))
    )


def _stations(world: Scenario) -> dict[str, tuple[tuple[float, ...], ...]]:
    """Positions of the stations of each sensor that has some."""
    models = {name: sensor.model for name, sensor in world.sensors.items()}
    return {
        n: tuple(map(tuple, m.stations)) for n, m in models.items() if isinstance(m, StationSensor)
    }


def _simulated(spec: WorldSpec, world: Scenario, told: list[str]) -> Member:
    def draw(trajectories: int, seed: int, purpose: str) -> Log:
        # Worlds draw disjoint numbers, the scenario's own those that it always had.
        where = purpose if spec.name == BASE else f"{purpose}:{spec.name}"
        log = simulate(world, trajectories, seed, where)
        inputs = dict(log.inputs)
        for name in told:
            stations = torch.tensor(_stations(world)[name], dtype=log.z.dtype)
            inputs[f"{name}.stations"] = stations.expand(*log.z.shape[:2], *stations.shape)
        return replace(log, inputs=inputs)

    return _member(spec, draw, world)


def _recorded(scenario: Scenario, spec: WorldSpec, log: Log) -> Member:
    names = _names(spec, log)
    whole = len(names) == log.trajectories
    return _member(spec, log if whole else log.select(names), scenario)


def _names(spec: WorldSpec, log: Log) -> list[int]:
    """Trajectories of a recorded log that belong to an entry; all to the first."""
    if spec.name == BASE:
        return list(range(log.trajectories))
    return [
        i
        for i, name in enumerate(log.names)
        if any(fnmatch.fnmatchcase(name, p) for p in spec.logs)
    ]


def _member(spec: WorldSpec, source: Any, world: Scenario) -> Member:
    def starter(recipe: Any, log: Log, values: Mapping[str, Tensor] | None) -> Log:
        return started(world, recipe, log, values)

    return Member(
        name=spec.name,
        source=source,
        weight=spec.weight,
        role=spec.role,
        allow=spec.allow,
        plausible=spec.plausible,
        starter=starter,
    )
