"""A scenario: the world, the sensors and their faults, the systems, what to tune."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from difffilter.errors import InputError, shown
from difffilter.logs.layout import Form
from difffilter.parameters.parameters import Parameter
from difffilter.scenario.build import System, build_system
from difffilter.scenario.document import SCHEMA, apply_overrides, check_texts, read_document
from difffilter.scenario.evaluation import (
    Reference,
    Scene,
    read_reference,
    read_scene,
    read_score,
)
from difffilter.scenario.faults import Fault
from difffilter.scenario.sensing import SensorSpec
from difffilter.scenario.settings import TuneSettings
from difffilter.scenario.starting import StartSpec
from difffilter.scenario.storage import read_form
from difffilter.scenario.systems import (
    MotionSpec,
    ParameterSpec,
    SystemSpec,
    read_motion,
    read_parameters,
    read_system,
)
from difffilter.scenario.table import Table
from difffilter.scenario.truth import read_truth
from difffilter.scenario.tuning import read_tuning
from difffilter.scenario.world import World
from difffilter.scenario.worlds import WorldSpec, check_worlds, read_worlds
from difffilter.scoring.metrics import Score

__all__ = ["Scenario", "load_scenario", "read_scenario"]


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
        worlds: of ``[[worlds]]``: others that the values must serve, too.
        score: which rows count.
        inputs: columns of known inputs in logs, the sensors' platform among them.
        runs: overrides for recorded runs, by the log file's stem.
        log: how recorded logs are stored; None for plain files.
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
    worlds: tuple[WorldSpec, ...]
    scenes: tuple[Scene, ...]
    score: Score
    inputs: tuple[str, ...]
    runs: Mapping[str, Mapping[str, Any]]
    references: tuple[Reference, ...]
    log: Form | None = None

    def system(self, name: str | None = None) -> System:
        """A system by name; the one to tune if no name is given.

        Raises:
            InputError: no such system, or a recipe that does not fit together.
        """
        name = name or self.tuning.system
        if name not in self.systems:
            expected = ", ".join(self.systems)
            raise InputError(f"system: found {shown(name)}, expected one of {expected}")
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
    check_texts(document, str(path))
    top = Table(document, str(path))
    if top.integer("schema") != SCHEMA:
        top.fail("schema", str(SCHEMA))
    truth = read_truth(top)
    systems = {
        name: read_system(name, part, truth.sensors) for name, part in top.table("systems").named()
    }
    if not systems:
        top.fail("systems", "one system or more")
    scenario = Scenario(
        name=top.label("name"),
        title=top.text("title"),
        source=top.text("source", ""),
        notes=top.names("notes", ()),
        path=path,
        document=document,
        **truth._asdict(),
        motion=read_motion(top.table("motion", optional=True)),
        parameters=read_parameters(top.table("parameters")),
        systems=systems,
        tuning=read_tuning(top.table("tuning", optional=True), tuple(systems)),
        worlds=read_worlds(top),
        scenes=tuple(read_scene(part) for part in top.tables("scenes")),
        score=read_score(top),
        inputs=_inputs(top, truth.sensors),
        runs={name: part.data for name, part in top.table("runs", optional=True).children()},
        log=read_form(top.table("log")) if "log" in top else None,
        references=tuple(read_reference(part) for part in top.tables("references")),
    )
    top.finish()
    _check_parameters(scenario)
    check_worlds(scenario)
    _check_runs(scenario)
    return scenario


def _inputs(top: Table, sensors: Mapping[str, SensorSpec]) -> tuple[str, ...]:
    platforms = [name for sensor in sensors.values() for name in sensor.platform]
    return tuple(dict.fromkeys((*top.names("inputs", ()), *platforms)))


def _check_parameters(scenario: Scenario) -> None:
    """Every system builds, and every parameter belongs to a system."""
    known = scenario.declarations()
    for name, spec in scenario.parameters.items():
        if name not in known and not any(other.endswith(f".{name}") for other in known):
            raise InputError(
                f"{spec.where}: no system has such a parameter, "
                f"expected one of {', '.join(sorted(known))}"
            )


def _check_runs(scenario: Scenario) -> None:
    """Every run's overrides fit."""
    alone = {k: value for k, value in scenario.document.items() if k not in ("runs", "worlds")}
    for name, run in scenario.runs.items():
        try:
            read_scenario(apply_overrides(alone, run), scenario.path)
        except InputError as error:
            raise InputError(f"{scenario.path}: runs.{name}: {error}") from None
