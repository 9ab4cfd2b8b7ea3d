"""What a scenario file says of its systems, their motion and their parameters."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from difffilter.baselines.registry import BASELINES
from difffilter.errors import InputError, shown
from difffilter.motions.protocol import Motion
from difffilter.motions.registry import MOTIONS
from difffilter.parameters.parameters import Number, Parameter, as_number
from difffilter.scenario.keys import keywords, missing, published, read_keys
from difffilter.scenario.modes import ModeSpec, read_modes
from difffilter.scenario.options import FUSIONS, OPTIONS, adaptation_names
from difffilter.scenario.sensing import SensorSpec
from difffilter.scenario.table import MEASURES, Table

__all__ = ["MotionSpec", "ParameterSpec", "SystemSpec", "read_system", "recipes"]

#: Patterns of the parameters that each mode of a system has for itself.
OWN = ("motion.*",)


@dataclass(frozen=True)
class ParameterSpec:
    """One entry of ``[parameters]``: published value and its unit (SI), source, tuned, prior.

    What is not said (None) is as the component declares it.
    """

    where: str
    value: Number
    unit: str
    source: str
    tuned: bool | None
    prior: float | None
    given: tuple[str, float] | None = None

    def declare(self, own: Parameter) -> Parameter:
        """The component's declaration with this published value."""
        if self.unit and self.unit != own.unit:
            raise InputError(f"{self.where}.unit: found {shown(self.unit)}, expected {own.unit!r}")
        declared = replace(
            own,
            value=self.value,
            source=self.source or own.source,
            tuned=own.tuned if self.tuned is None else self.tuned,
            prior=own.prior if self.prior is None else self.prior,
            given=self.given,
        )
        try:
            own.check(declared.tensor())  # own: the shape as well
        except InputError as error:
            raise InputError(f"{self.where}.value: {error}") from None
        return declared


@dataclass(frozen=True)
class MotionSpec:
    """``[motion]``: the model's name in :data:`MOTIONS`, and its keys."""

    model: str
    keys: Mapping[str, Any]

    def build(self, axes: int, parameters: Mapping[str, ParameterSpec]) -> Motion:
        """The model with published values; InputError where one that it needs is missing."""
        factory = MOTIONS[self.model]
        values = {name: parameter.value for name, parameter in parameters.items()}
        given = {**self.keys, **published(factory, "motion", values)}
        if "axes" in keywords(factory):
            given["axes"] = axes
        lacking = missing(factory, given)
        if lacking is not None:
            raise InputError(f"needs [parameters.motion.{lacking}] or motion.{lacking}, found none")
        return factory(**given)

    def as_dict(self) -> dict[str, Any]:
        """As a checkpoint lists it."""
        return {"model": self.model, **self.keys}


@dataclass(frozen=True)
class SystemSpec:
    """One entry of ``[systems]``, as read.

    Attributes:
        options: of a filter, by key (see :mod:`difffilter.scenario.options`).
        common_noise: whether a TDOA sensor's noise is partly common to its channels.
        values: published values of its own, by parameter.
        modes: filters that run at once, see :class:`difffilter.Mixture`; own: patterns of the
            parameters that each of them has for itself.
    """

    name: str
    where: str
    estimator: str
    options: Mapping[str, Any]
    fusion: str
    common_noise: bool
    sensors: tuple[str, ...]
    values: Mapping[str, Number]
    note: str
    modes: tuple[ModeSpec, ...] = ()
    own: tuple[str, ...] = OWN

    @property
    def clairvoyant(self) -> bool:
        """Whether it is told of faults."""
        return bool(self.options["clairvoyant"])

    @property
    def recipe(self) -> dict[str, Any]:
        """Every key with its value, as a checkpoint lists them."""
        return {
            "name": self.name,
            "estimator": self.estimator,
            **self.options,
            "fusion": self.fusion,
            "common_noise": self.common_noise,
            "sensors": self.sensors,
            "values": self.values,
            **self._several,
        }

    @property
    def _several(self) -> dict[str, Any]:
        if not self.modes:
            return {}
        return {"modes": {mode.name: mode.as_dict() for mode in self.modes}, "own": self.own}


def read_motion(table: Table) -> MotionSpec:
    """Read ``[motion]``."""
    model = table.text("model", "constant-velocity", choices=tuple(MOTIONS))
    spec = MotionSpec(model, read_keys(table, MOTIONS[model], ("axes",)))
    table.finish()
    return spec


def read_system(name: str, table: Table, sensors: Mapping[str, SensorSpec]) -> SystemSpec:
    """Read ``[systems.NAME]``; by default it uses every sensor that is not pooled of others."""
    own = tuple(name for name, sensor in sensors.items() if not sensor.pool)
    spec = SystemSpec(
        name=name,
        where=f"{table.where}: {table.path}",
        estimator=table.text("estimator", "filter", choices=("filter", *BASELINES)),
        options={key: option.read(table, key) for key, option in OPTIONS.items()},
        fusion=table.text("fusion", "none", choices=FUSIONS),
        common_noise=table.flag("common_noise"),
        sensors=table.names("sensors", own),
        values=_read_values(table.table("values", optional=True)),
        note=table.text("note", ""),
        modes=read_modes(table.table("modes", optional=True), read_motion),
        own=table.names("own", OWN),
    )
    for key in (*OPTIONS, "fusion"):
        if spec.modes and key in table:
            table.fail(key, "no such key beside modes: each mode has its own")
    if spec.modes and spec.estimator != "filter":
        table.fail("modes", f"no such key beside estimator = {spec.estimator!r}")
    if not spec.sensors or len(set(spec.sensors)) != len(spec.sensors):
        table.fail("sensors", "one name or more, none twice")
    for sensor in spec.sensors:
        if sensor not in sensors:
            table.fail("sensors", f"names among {', '.join(sensors)}")
    for key in (*OPTIONS, "fusion"):
        if key in table and spec.estimator != "filter":
            table.fail(key, f"no such key beside estimator = {spec.estimator!r}")
    _check_together(table, spec)
    table.finish()
    return spec


def _check_together(table: Table, spec: SystemSpec) -> None:
    """Options of a filter that exclude each other, named by their keys."""
    adaptations = adaptation_names(spec.options["adaptation"])
    credible = any("credibility" in name for name in adaptations)
    if credible and spec.common_noise:
        table.fail("adaptation", "no credibility together with common_noise")
    if credible and len(spec.sensors) < 2:
        table.fail("adaptation", "two sensors or more with credibility")
    if spec.options["federated"] and len(spec.sensors) < 2:
        table.fail("federated", "two sensors or more with it")


def _read_values(table: Table) -> dict[str, Number]:
    return {name: as_number(table.nested(name)) for name in table.data}


def read_parameters(table: Table) -> dict[str, ParameterSpec]:
    """Read ``[parameters.COMPONENT.NAME]`` tables."""
    specs = {}
    for component, group in table.children():
        for field, entry in group.children():
            unit = entry.text("unit", "")
            value, given = entry.nested("value"), None
            for base, factors in MEASURES.items():
                if unit in factors:
                    given = (unit, factors[unit]) if factors[unit] != 1.0 else None
                    value, unit = _scaled(value, factors[unit]), base
                    break
            specs[f"{component}.{field}"] = ParameterSpec(
                where=f"{entry.where}: {entry.path}",
                value=value,
                unit=unit,
                source=entry.text("source", ""),
                tuned=entry.flag("tuned") if "tuned" in entry else None,
                prior=entry.number("prior", None, above=0.0),
                given=given,
            )
            entry.finish()
    return specs


def _scaled(value: Number, factor: float) -> Number:
    if isinstance(value, tuple):
        return tuple(_scaled(item, factor) for item in value)  # type: ignore[return-value]
    return value * factor


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
