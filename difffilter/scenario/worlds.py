"""``[[worlds]]`` of a scenario: worlds beside its own that its values must serve, too."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

from difffilter.errors import InputError, shown
from difffilter.logs.family import ROLES
from difffilter.scenario.document import apply_overrides
from difffilter.scenario.table import Table
from difffilter.scenario.truth import read_truth
from difffilter.sensors.builtin import PositionSensor, StationSensor

if TYPE_CHECKING:
    from difffilter.scenario.scenario import Scenario

__all__ = ["BASE", "WorldSpec", "changed", "check_worlds", "read_worlds", "scenario_of_world"]

#: Name of the scenario's own world, or of all recorded logs, in its family.
BASE = "base"
#: What a world may change: the truth, not the filters. Patterns of dotted keys.
CHANGES = (
    "world.*",
    "faults.*",
    "start.*",
    "sensors.*.noise.*",
    "sensors.*.every",
    "sensors.*.stations",
)
#: Tables that say nothing of the truth.
OTHERS = ("worlds", "runs", "systems", "parameters", "tuning", "motion")


@dataclass(frozen=True)
class WorldSpec:
    """One entry of ``[[worlds]]``.

    Attributes:
        name, weight, role, allow, plausible: as for :class:`Member`.
        overrides: dotted keys of the truth and their values, in a simulated world.
        times: dotted keys of numbers of the truth, and what they are multiplied by.
        logs: patterns of the names of recorded logs, in a recorded one.
    """

    name: str
    where: str = ""
    weight: float = 1.0
    role: str = "guard"
    allow: float = 1.02
    plausible: str = ""
    overrides: Mapping[str, Any] = field(default_factory=dict)
    times: Mapping[str, float] = field(default_factory=dict)
    logs: tuple[str, ...] = ()

    @property
    def simulated(self) -> bool:
        """Whether it changes a simulated world."""
        return bool(self.overrides or self.times)


def read_worlds(top: Table) -> tuple[WorldSpec, ...]:
    """Read ``[[worlds]]``; whether the overrides fit is checked with the whole scenario."""
    found: list[WorldSpec] = []
    for part in top.tables("worlds"):
        base = part.data.get("name") == BASE
        overrides = _changes(part.table("overrides", optional=True))
        times = _changes(part.table("times", optional=True))
        spec = WorldSpec(
            name=part.label("name"),
            where=f"{part.where}: {part.path}",
            weight=part.number("weight", 1.0, above=0.0),
            role=part.text("role", "tune" if base else "guard", choices=ROLES),
            allow=part.number("allow", 1.02, low=1.0),
            plausible=part.text("plausible", ""),
            overrides=dict(overrides.data),
            times={key: times.number(key) for key in times.data},
            logs=part.names("logs", ()),
        )
        if spec.name in {other.name for other in found}:
            part.fail("name", "no name twice")
        if base and (spec.simulated or spec.logs):
            part.fail("name", f"no overrides, times or logs beside the scenario's own, {BASE!r}")
        if not base and spec.simulated == bool(spec.logs):
            part.fail("overrides", "overrides or times of a simulated world, or names of logs")
        if spec.simulated and "world" not in top:
            part.fail("overrides", "logs in place of them in a scenario without [world]")
        part.finish()
        found.append(spec)
    return tuple(found)


def _changes(table: Table) -> Table:
    """The table, each of whose keys is one of the truth."""
    for key in table.data:
        if not any(fnmatch.fnmatchcase(key, pattern) for pattern in CHANGES):
            table.fail(key, f"a quoted dotted key of the truth: {', '.join(CHANGES)}")
    return table


def check_worlds(scenario: Scenario) -> None:
    """InputError where an entry's overrides do not fit the scenario."""
    for spec in scenario.worlds:
        world = changed(scenario, spec)
        if world.axes != scenario.axes or world.channels != scenario.channels:
            raise InputError(f"{spec.where}: found other axes or channels than the scenario's own")
        for name, sensor in world.sensors.items():
            if _shape(sensor.model) != _shape(scenario.sensors[name].model):
                raise InputError(
                    f"{spec.where}: sensors.{name}.stations: expected as many stations and "
                    "coordinates as the scenario's own"
                )


def _shape(model: PositionSensor) -> list[int]:
    """Coordinates of each station."""
    return [len(at) for at in model.stations] if isinstance(model, StationSensor) else []


def changed(scenario: Scenario, spec: WorldSpec) -> Scenario:
    """The scenario with the truth of that world, and its own systems."""
    document = {key: value for key, value in scenario.document.items() if key not in OTHERS}
    try:
        document = apply_overrides(document, spec.overrides)
        scaled = {key: _product(document, key, factor) for key, factor in spec.times.items()}
        document = apply_overrides(document, scaled)
    except InputError as error:
        raise InputError(f"{spec.where}: {error}") from None
    truth = read_truth(Table(document, spec.where))
    return replace(scenario, **truth._asdict(), worlds=())


def _product(document: Mapping[str, Any], path: str, factor: float) -> Any:
    """The number, or the list of numbers, at a dotted key, times a factor.

    A probability goes up to 1: no fault is more frequent than always.
    """
    value: Any = document
    for key in path.split("."):
        if isinstance(value, Mapping):
            value = value.get(key)
        else:
            at = int(key) if key.isdecimal() else -1
            value = value[at] if isinstance(value, list) and 0 <= at < len(value) else None

    def times(item: Any) -> Any:
        if isinstance(item, list):
            return [times(part) for part in item]
        if isinstance(item, bool) or not isinstance(item, int | float):
            raise InputError(f"times.{path}: found {shown(value)}, expected numbers to multiply")
        return item * factor

    scaled = times(value)
    return min(scaled, 1.0) if path.endswith(".probability") else scaled


def scenario_of_world(scenario: Scenario, name: str) -> Scenario:
    """The scenario with the truth of one of its ``[[worlds]]``, and its systems as they are.

    Raises:
        InputError: no such world, or one of recorded logs.
    """
    if name == BASE:
        return scenario
    for spec in scenario.worlds:
        if spec.name == name and not spec.logs:
            return changed(scenario, spec)
    known = [BASE, *(spec.name for spec in scenario.worlds if not spec.logs)]
    raise InputError(f"world: found {shown(name)}, expected one of {', '.join(known)}")
