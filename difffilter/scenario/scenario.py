"""A scenario: the world, the sensors and their faults, the systems, what to tune."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from difffilter.errors import InputError
from difffilter.parameters.parameters import Parameter
from difffilter.scenario.build import System, build_system
from difffilter.scenario.document import SCHEMA, apply_overrides, read_document
from difffilter.scenario.faults import Fault, read_fault
from difffilter.scenario.pooling import pooled_sigma
from difffilter.scenario.sensing import SensorSpec, read_sensor
from difffilter.scenario.settings import TuneSettings
from difffilter.scenario.systems import (
    MotionSpec,
    ParameterSpec,
    SystemSpec,
    read_motion,
    read_parameters,
    read_system,
)
from difffilter.scenario.table import Table
from difffilter.scenario.tuning import read_tuning
from difffilter.scenario.world import World, read_world
from difffilter.scoring.metrics import SCORES, Score
from difffilter.sensors.position import Position

__all__ = ["Scenario", "Scene", "StartSpec", "load_scenario"]

STARTS = ("truth", "measurements", "bearings")


@dataclass(frozen=True)
class Scene:
    """A named stretch of a trajectory, for errors per scene: first <= k <= last."""

    name: str
    first: int
    last: int


@dataclass(frozen=True)
class StartSpec:
    """How trajectories start.

    Attributes:
        kind: ``truth`` (simulation only: truth plus normal errors), ``measurements``, or
            ``bearings`` (the first ones crossed).
        position_sigma, velocity_sigma: standard deviation of those errors, m and m/s.
        rows: rows that a start from measurements reads.
        unknown_velocity: m/s, standard deviation of the velocity in a start from
            measurements; None for the filter's own ``start.sigma``.
        velocity: m/s, of the target, where it is known (``bearings``).
    """

    kind: str
    position_sigma: float
    velocity_sigma: float
    rows: int
    unknown_velocity: float | None
    velocity: tuple[float, ...] | None = None


@dataclass(frozen=True)
class Reference:
    """A result that somebody else published, for tables: not produced by this library."""

    run: str
    system: str
    rmse: float
    source: str


@dataclass(frozen=True)
class Scenario:
    """Everything that a scenario file says, validated.

    Attributes:
        name, title, source, notes: as in the file; path: where it was found.
        document: the file's contents with inheritance and overrides applied.
        axes: components of the position.
        world: None for a scenario of recorded logs.
        sensors, faults, systems: by name; motion, start: what all systems share.
        parameters: declarations by component and name.
        tuning: settings of ``[tuning]``; scenes: of ``[[scenes]]``.
        score: which rows count.
        inputs: columns of known inputs in logs, the sensors' platform among them.
        runs: overrides for recorded runs, by the log file's stem.
    """

    name: str
    title: str
    source: str
    notes: tuple[str, ...]
    path: Path
    document: Mapping[str, Any]
    axes: int
    world: World | None
    sensors: Mapping[str, SensorSpec]
    faults: Mapping[str, Fault]
    start: StartSpec
    motion: MotionSpec
    parameters: Mapping[str, ParameterSpec]
    systems: Mapping[str, SystemSpec]
    tuning: TuneSettings
    scenes: tuple[Scene, ...]
    score: Score
    inputs: tuple[str, ...]
    runs: Mapping[str, Mapping[str, Any]]
    references: tuple[Reference, ...]

    def system(self, name: str | None = None) -> System:
        """A system by name; the one to tune if no name is given.

        Raises:
            InputError: no such system, or a recipe that does not fit together.
        """
        name = name or self.tuning.system
        if name not in self.systems:
            raise InputError(f"system: found {name!r}, expected one of {', '.join(self.systems)}")
        return build_system(
            self.systems[name],
            self.axes,
            self.motion,
            self.sensors,
            self.parameters,
            self.start.velocity,
        )

    @property
    def channels(self) -> tuple[str, ...]:
        """Channels of all sensors, in order."""
        return tuple(c for sensor in self.sensors.values() for c in sensor.model.channels)

    def declarations(self) -> dict[str, Parameter]:
        """Every parameter of every system, by name."""
        found: dict[str, Parameter] = {}
        for name in self.systems:
            for parameter in self.system(name).declarations.values():
                found.setdefault(parameter.name, parameter)
        return found

    def with_overrides(self, overrides: Mapping[str, Any]) -> Scenario:
        """The same scenario with dotted keys overridden, checked like the file itself.

        Raises:
            InputError: names the key, what was found and what was expected.
        """
        return read_scenario(apply_overrides(dict(self.document), overrides), self.path)


def load_scenario(name: str | Path, overrides: Mapping[str, Any] | None = None) -> Scenario:
    """Load a scenario by name, or from the user's own .toml file.

    Args:
        name: as ``difffilter scenarios`` lists it, or a path that ends in .toml.
        overrides: dotted keys and values, for example ``{"faults.nlos.scale": 50.0}``.

    Raises:
        InputError: names the file, the key, what was found and what was expected.

    Example:
        >>> from difffilter import load_scenario
        >>> load_scenario("airport-mlat", {"world.steps": 1000}).world.steps
        1000
    """
    document, path = read_document(name)
    return read_scenario(apply_overrides(document, overrides or {}), path)


def read_scenario(document: dict[str, Any], path: Path) -> Scenario:
    """Validate a parsed scenario."""
    top = Table(document, str(path))
    if top.integer("schema") != SCHEMA:
        top.fail("schema", str(SCHEMA))
    world = read_world(top.table("world")) if "world" in top else None
    axes = world.axes if world else top.integer("axes", 2, low=1)
    sensors = {
        name: read_sensor(name, part, axes) for name, part in top.table("sensors").children()
    }
    if not sensors:
        top.fail("sensors", "one sensor or more")
    sensors = {name: _pooled(top, name, sensor, sensors) for name, sensor in sensors.items()}
    channels = [c for sensor in sensors.values() for c in sensor.model.channels]
    if len(set(channels)) != len(channels):
        top.fail("sensors", "no channel name twice")
    parts = top.table("faults", optional=True).children()
    faults = {name: read_fault(name, part, sensors.values()) for name, part in parts}
    if faults and world is None:
        top.fail("faults", "none in a scenario without [world]")
    _check_platform(str(path), world, sensors)
    for name, sensor in sensors.items():
        if sensor.every > 1 and world is None:
            top.table("sensors").table(name).fail("every", "none in a scenario without [world]")
    systems = {
        name: read_system(name, part, sensors) for name, part in top.table("systems").children()
    }
    if not systems:
        top.fail("systems", "one system or more")
    scenario = Scenario(
        name=top.text("name"),
        title=top.text("title"),
        source=top.text("source", ""),
        notes=top.names("notes", ()),
        path=path,
        document=document,
        axes=axes,
        world=world,
        sensors=sensors,
        faults=faults,
        start=_read_start(top.table("start", optional=True), world is not None, axes),
        motion=read_motion(top.table("motion", optional=True)),
        parameters=read_parameters(top.table("parameters")),
        systems=systems,
        tuning=read_tuning(top.table("tuning", optional=True), tuple(systems)),
        scenes=tuple(_read_scene(part) for part in top.tables("scenes")),
        score=_read_score(top),
        inputs=_inputs(top, sensors),
        runs={name: part.data for name, part in top.table("runs", optional=True).children()},
        references=tuple(_read_reference(part) for part in top.tables("references")),
    )
    top.finish()
    _check_parameters(scenario)
    return scenario


def _read_score(top: Table) -> Score:
    rows = top.text("score", "all", choices=SCORES)
    first, last = top.numbers("score_times", 2, (-math.inf, math.inf))
    if last < first:
        top.fail("score_times", "[first, last] with first <= last")
    return Score(rows, first, last)


def _pooled(
    top: Table, name: str, sensor: SensorSpec, sensors: Mapping[str, SensorSpec]
) -> SensorSpec:
    """A pooled sensor with the noise that its members leave; others as they are."""
    if not sensor.pool:
        return sensor
    part = top.table("sensors").table(name)
    for member in sensor.pool:
        if member not in sensors or sensors[member].pool or member == name:
            part.fail("pool", f"other sensors among {', '.join(sensors)}")
        if len(sensors[member].model.channels) != len(sensor.model.channels):
            part.fail("pool", "sensors of as many channels")
        if not isinstance(sensors[member].model, Position):
            part.fail("pool", "sensors of kind position")
    sigma = pooled_sigma([sensors[member] for member in sensor.pool])
    return replace(sensor, sigma=sigma, model=replace(sensor.model, sigma=sigma))


def _check_platform(where: str, world: World | None, sensors: Mapping[str, SensorSpec]) -> None:
    """A sensor rides the world's platform, and no other."""
    riding = {name: sensor.platform for name, sensor in sensors.items() if sensor.platform}
    if world is None:
        return
    for name, platform in riding.items():
        if platform != world.platform_inputs:
            expected = ", ".join(world.platform_inputs) or "none without [world.platform]"
            raise InputError(
                f"{where}: sensors.{name}.platform: found {list(platform)}, "
                f"expected the inputs of [world.platform]: {expected}"
            )
    if world.platform and not riding:
        raise InputError(f"{where}: world.platform: found one, expected a sensor that rides it")


def _inputs(top: Table, sensors: Mapping[str, SensorSpec]) -> tuple[str, ...]:
    platforms = [name for sensor in sensors.values() for name in sensor.platform]
    return tuple(dict.fromkeys((*top.names("inputs", ()), *platforms)))


def _read_start(table: Table, simulated: bool, axes: int) -> StartSpec:
    kind = table.text("kind", "truth" if simulated else "measurements", choices=STARTS)
    if kind == "truth" and not simulated:
        table.fail("kind", "'measurements' or 'bearings' in a scenario without [world]")
    spec = StartSpec(
        kind,
        table.number("position_sigma", 0.0, low=0.0),
        table.number("velocity_sigma", 0.0, low=0.0),
        table.integer("rows", 10, low=1),
        table.number("unknown_velocity", None, above=0.0),
        table.numbers("velocity", axes, None),
    )
    if kind == "bearings" and spec.velocity is None:
        table.fail("velocity", f"{axes} numbers beside kind = 'bearings'")
    if kind == "bearings" and spec.rows < 2:
        table.fail("rows", "2 or more beside kind = 'bearings'")
    table.finish()
    return spec


def _read_scene(table: Table) -> Scene:
    scene = Scene(table.text("name"), table.integer("first", low=1), table.integer("last", low=1))
    if scene.last < scene.first:
        table.fail("last", f"a step of first = {scene.first} or later")
    table.finish()
    return scene


def _read_reference(table: Table) -> Reference:
    reference = Reference(
        table.text("run", ""),
        table.text("system"),
        table.number("rmse", above=0.0),
        table.text("source"),
    )
    table.finish()
    return reference


def _check_parameters(scenario: Scenario) -> None:
    """Every system and run builds, and every parameter belongs to a system."""
    known = scenario.declarations()
    for name, spec in scenario.parameters.items():
        if name not in known:
            raise InputError(
                f"{spec.where}: no system has such a parameter, "
                f"expected one of {', '.join(sorted(known))}"
            )
    alone = {key: value for key, value in scenario.document.items() if key != "runs"}
    for name, run in scenario.runs.items():
        try:
            read_scenario(apply_overrides(alone, run), scenario.path)
        except InputError as error:
            raise InputError(f"{scenario.path}: runs.{name}: {error}") from None
