"""What a scenario file says of its systems, their motion and their parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from difffilter.errors import InputError
from difffilter.filters.filter import RULES, STANDARDISATIONS
from difffilter.motions.blocks import NOISES, ConstantVelocity, CoordinatedTurn
from difffilter.parameters.parameters import Number, Parameter, as_number
from difffilter.robust.gate import ACTIONS
from difffilter.robust.groups import DISTANCES, SCOPES, Scope
from difffilter.robust.recovery import RECOVERIES
from difffilter.scenario.sensing import SensorSpec
from difffilter.scenario.table import MEASURES, Table
from difffilter.weights.registry import WEIGHTS

__all__ = ["MotionSpec", "ParameterSpec", "SystemSpec", "read_system", "recipes"]

ESTIMATORS = ("filter", "taylor-ls", "chan-ls", "chan-ekf", "bearing-ls", "bearing-wls")
ADAPTATIONS = (
    "innovation-scaling", "credibility", "ideal-credibility", "innovation-matching",
    "prediction-correction", "strong-tracking", "multiple-fading",
)  # fmt: skip
MODELS = ("constant-velocity", "coordinated-turn")
FUSIONS = ("none", "distributed")
#: Keys of a system that no baseline reads.
FILTER_KEYS = (
    "weight",
    "standardise",
    "iterations",
    "weigh_prior",
    "mad",
    "scope",
    "distance",
    "gate",
    "recovery",
    "federated",
    "shares",
    "adaptation",
    "linearise",
    "fusion",
    "clairvoyant",
)


@dataclass(frozen=True)
class ParameterSpec:
    """One entry of ``[parameters]``: published value and its unit (SI), source, tuned, prior."""

    where: str
    value: Number
    unit: str
    source: str
    tuned: bool
    prior: float | None

    def declare(self, own: Parameter) -> Parameter:
        """The component's declaration with this published value."""
        if self.unit and self.unit != own.unit:
            raise InputError(f"{self.where}.unit: found {self.unit!r}, expected {own.unit!r}")
        declared = replace(
            own,
            value=self.value,
            source=self.source or own.source,
            tuned=self.tuned,
            prior=self.prior,
        )
        try:
            own.check(declared.tensor())  # own: the shape as well
        except InputError as error:
            raise InputError(f"{self.where}.value: {error}") from None
        return declared


@dataclass(frozen=True)
class MotionSpec:
    """``[motion]``: constant velocity or a coordinated turn, and the kind of noise."""

    noise: str
    model: str = "constant-velocity"

    def build(self, axes: int, level: Number) -> ConstantVelocity:
        """The model at a level of noise."""
        if self.model == "coordinated-turn":
            return CoordinatedTurn(axes, self.noise, level)
        return ConstantVelocity(axes, self.noise, level)

    @property
    def parameter(self) -> str:
        """Name of the noise's parameter."""
        return "motion.state_sigma" if self.noise == "state" else "motion.acceleration"


@dataclass(frozen=True)
class SystemSpec:
    """One entry of ``[systems]``, as read."""

    name: str
    where: str
    estimator: str
    weight: str
    standardise: str | None
    iterations: int
    weigh_prior: bool
    mad: bool
    scope: Scope
    distance: str
    gate: str
    recovery: str
    federated: bool
    shares: tuple[float, ...]
    adaptation: str | tuple[str, ...]
    linearise: str
    fusion: str
    clairvoyant: bool
    common_noise: bool
    sensors: tuple[str, ...]
    values: Mapping[str, Number]
    note: str

    @property
    def adaptations(self) -> tuple[str, ...]:
        """Names of the plug-ins, in order."""
        if isinstance(self.adaptation, tuple):
            return self.adaptation
        return () if self.adaptation == "none" else (self.adaptation,)


def read_motion(table: Table) -> MotionSpec:
    """Read ``[motion]``."""
    spec = MotionSpec(
        table.text("noise", "discrete", choices=NOISES),
        table.text("model", "constant-velocity", choices=MODELS),
    )
    table.finish()
    return spec


def read_system(name: str, table: Table, sensors: Mapping[str, SensorSpec]) -> SystemSpec:
    """Read ``[systems.NAME]``; by default it uses every sensor that is not pooled of others."""
    own = tuple(name for name, sensor in sensors.items() if not sensor.pool)
    spec = SystemSpec(
        name,
        f"{table.where}: {table.path}",
        table.text("estimator", "filter", choices=ESTIMATORS),
        table.text("weight", "plain", choices=tuple(WEIGHTS)),
        table.text("standardise", None, choices=STANDARDISATIONS),
        table.integer("iterations", 0),
        table.flag("weigh_prior"),
        table.flag("mad"),
        _read_scope(table),
        table.text("distance", "rms", choices=DISTANCES),
        table.text("gate", "none", choices=("none", *ACTIONS)),
        table.text("recovery", "none", choices=("none", *RECOVERIES)),
        table.flag("federated"),
        table.numbers("shares", None, ()),
        _read_adaptation(table),
        table.text("linearise", "taylor", choices=RULES),
        table.text("fusion", "none", choices=FUSIONS),
        table.flag("clairvoyant"),
        table.flag("common_noise"),
        table.names("sensors", own),
        _read_values(table.table("values", optional=True)),
        table.text("note", ""),
    )
    if not spec.sensors or len(set(spec.sensors)) != len(spec.sensors):
        table.fail("sensors", "one name or more, none twice")
    for sensor in spec.sensors:
        if sensor not in sensors:
            table.fail("sensors", f"names among {', '.join(sensors)}")
    for key in FILTER_KEYS:
        if key in table and spec.estimator != "filter":
            table.fail(key, f"no such key beside estimator = {spec.estimator!r}")
    if spec.adaptations and spec.common_noise and spec.weigh_prior:
        table.fail("adaptation", "none together with common_noise and weigh_prior")
    credible = any("credibility" in name for name in spec.adaptations)
    if credible and spec.common_noise:
        table.fail("adaptation", "no credibility together with common_noise")
    if credible and len(spec.sensors) < 2:
        table.fail("adaptation", "two sensors or more with credibility")
    if spec.federated and len(spec.sensors) < 2:
        table.fail("federated", "two sensors or more with it")
    table.finish()
    return spec


def _read_scope(table: Table) -> Scope:
    """``scope``: a word, or a table of groups of channels."""
    if not isinstance(table.data.get("scope"), dict):
        return table.text("scope", "channel", choices=SCOPES)
    groups = table.table("scope")
    return {name: groups.names(name) for name in groups.data}


def _read_values(table: Table) -> dict[str, Number]:
    return {name: as_number(table.nested(name)) for name in table.data}


def read_parameters(table: Table) -> dict[str, ParameterSpec]:
    """Read ``[parameters.COMPONENT.NAME]`` tables."""
    specs = {}
    for component, group in table.children():
        for field, entry in group.children():
            unit = entry.text("unit", "")
            value = entry.nested("value")
            for base, factors in MEASURES.items():
                if unit in factors:
                    value, unit = _scaled(value, factors[unit]), base
                    break
            specs[f"{component}.{field}"] = ParameterSpec(
                f"{entry.where}: {entry.path}",
                value,
                unit,
                entry.text("source", ""),
                entry.flag("tuned"),
                entry.number("prior", None, above=0.0),
            )
            entry.finish()
    return specs


def _scaled(value: Number, factor: float) -> Number:
    if isinstance(value, tuple):
        return tuple(_scaled(item, factor) for item in value)  # type: ignore[return-value]
    return value * factor


def _read_adaptation(table: Table) -> str | tuple[str, ...]:
    """``adaptation``: a name, or a list of names."""
    if isinstance(table.data.get("adaptation"), list):
        names = table.names("adaptation")
        if not set(names) <= set(ADAPTATIONS) or len(set(names)) != len(names):
            table.fail("adaptation", f"names among {', '.join(ADAPTATIONS)}, none twice")
        return names
    return table.text("adaptation", "none", choices=("none", *ADAPTATIONS))


def recipes(systems: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """Each system of a document in words: its keys, and its note."""
    found = {}
    for name, recipe in systems.items():
        parts = [f"{key} {_plain(value)}" for key, value in recipe.items() if key != "note"]
        note = f" ({recipe['note']})" if "note" in recipe else ""
        found[name] = (", ".join(parts) or "plain filter") + note
    return found


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return "+".join(map(str, value)) if isinstance(value, list) else str(value)
