"""The systems of a scenario (filters and baselines) and the values of their parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

from difffilter.adaptation import (
    Chain,
    InnovationMatching,
    MultipleFading,
    PredictionCorrection,
    StrongTracking,
)
from difffilter.baselines.adaptive import InnovationScaling
from difffilter.baselines.bearing_lines import BearingLeastSquares
from difffilter.baselines.chan import ChanLeastSquares
from difffilter.baselines.chan_ekf import ChanEKF
from difffilter.baselines.least_squares import TaylorLeastSquares
from difffilter.credibility import Credibility
from difffilter.errors import InputError
from difffilter.filter import RULES, STANDARDISATIONS, Adaptation, Filter
from difffilter.fusion import Fusion
from difffilter.gate import ACTIONS, Gate
from difffilter.groups import DISTANCES, SCOPES, Scope, channel_groups
from difffilter.motion import NOISES, ConstantVelocity, CoordinatedTurn
from difffilter.parameters import Number, Parameter, as_number
from difffilter.recovery import RECOVERIES, Recovery
from difffilter.scenario.sensing import SensorSpec
from difffilter.scenario.table import MEASURES, Table
from difffilter.sensors import TDOA, PositionSensor
from difffilter.weights import WEIGHTS, weight_named

__all__ = ["MotionSpec", "ParameterSpec", "System", "SystemSpec", "build_system", "read_system"]

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

#: What a scenario calls a system: a recursive filter, or a baseline estimator.
System = Filter | TaylorLeastSquares | ChanLeastSquares | ChanEKF | BearingLeastSquares


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


def build_system(
    spec: SystemSpec,
    axes: int,
    motion: MotionSpec,
    sensors: Mapping[str, SensorSpec],
    parameters: Mapping[str, ParameterSpec],
    velocity: tuple[float, ...] | None = None,
) -> System:
    """The filter or baseline of a system, with published values declared.

    ``velocity`` is the target's, where the scenario's start knows it.
    """
    parameters = _own_values(spec, parameters)

    def value(name: str) -> Number | None:
        return parameters[name].value if name in parameters else None

    def where(text: object) -> InputError:
        return InputError(f"{spec.where}: {text}")

    chosen = [sensors[name] for name in spec.sensors]
    models = tuple(
        sensor.for_filter(
            value(f"{sensor.model.name}.sigma"),
            value(f"{sensor.model.name}.bias"),
            spec.common_noise,
        )
        for sensor in chosen
    )
    if spec.common_noise and not any(isinstance(model, TDOA) for model in models):
        raise where("common_noise: found no TDOA sensor, expected one with it")
    level = value(motion.parameter)
    if level is None and spec.estimator in ("filter", "chan-ekf"):
        raise where(f"needs [parameters.{motion.parameter}], found none")
    try:
        moving = motion.build(axes, 1.0 if level is None else level)
        bare = _bare_system(spec, axes, moving, models, value("start.sigma"), velocity)
        own = bare.declarations
    except InputError as error:
        raise where(error) from None
    for name in spec.values:
        if name not in own:
            raise where(f"values: found {name}, expected one of {', '.join(own)}")
    declared = {name: p.declare(own[name]) for name, p in parameters.items() if name in own}
    return replace(bare, overrides=declared)


def _own_values(
    spec: SystemSpec, parameters: Mapping[str, ParameterSpec]
) -> Mapping[str, ParameterSpec]:
    """The scenario's parameters with the system's own values in their place."""
    where = f"{spec.where}.values"
    blank = ParameterSpec(where, 0.0, "", "", tuned=False, prior=None)
    own = {
        name: replace(
            parameters.get(name, blank), where=f"{where}.{name}", value=value, source=f"{spec.name}"
        )
        for name, value in spec.values.items()
    }
    return {**parameters, **own}


def _bare_system(
    spec: SystemSpec,
    axes: int,
    motion: ConstantVelocity,
    sensors: tuple[PositionSensor, ...],
    start_sigma: Number | None,
    velocity: tuple[float, ...] | None,
) -> System:
    """The recipe alone."""
    if spec.estimator in ("bearing-ls", "bearing-wls"):
        if velocity is None:
            raise InputError("estimator: found no velocity in [start], expected the target's")
        weighted = spec.estimator == "bearing-wls"
        return BearingLeastSquares(sensors, axes, velocity=velocity, weighted=weighted)
    if spec.estimator == "taylor-ls":
        return TaylorLeastSquares(sensors, axes)
    if spec.estimator == "chan-ls":
        return ChanLeastSquares(sensors, axes)
    if spec.estimator == "chan-ekf":
        return ChanEKF(sensors, axes, motion=motion, start_sigma=start_sigma)
    return Filter(
        motion,
        sensors,
        weight_named(spec.weight),
        standardise=spec.standardise,
        iterations=spec.iterations,
        weigh_prior=spec.weigh_prior,
        mad=spec.mad,
        scope=spec.scope,
        distance=spec.distance,
        gate=None if spec.gate == "none" else Gate(spec.gate),
        recovery=None if spec.recovery == "none" else Recovery(spec.recovery),
        federated=spec.federated,
        shares=spec.shares,
        adaptation=_adaptation(spec, sensors, axes),
        fusion=None if spec.fusion == "none" else Fusion(axes),
        linearise=spec.linearise,
        clairvoyant=spec.clairvoyant,
        start_sigma=start_sigma,
    )


def _adaptation(
    spec: SystemSpec, sensors: tuple[PositionSensor, ...], axes: int
) -> Adaptation | None:
    """The plug-in of that name, or a chain of several."""
    counts = [len(sensor.channels) for sensor in sensors]
    channels = [c for sensor in sensors for c in sensor.channels]
    systems = channel_groups("sensor", channels, counts)
    weight = weight_named(spec.weight)
    build: dict[str, Callable[[], Adaptation]] = {
        "innovation-scaling": InnovationScaling,
        "credibility": lambda: Credibility(systems, axes),
        "ideal-credibility": lambda: Credibility(systems, axes, ideal=True),
        "innovation-matching": InnovationMatching,
        "prediction-correction": lambda: PredictionCorrection(axes),
        "strong-tracking": lambda: StrongTracking(weight),
        "multiple-fading": lambda: MultipleFading(weight),
    }
    parts = tuple(build[name]() for name in spec.adaptations)
    if not parts:
        return None
    return parts[0] if len(parts) == 1 else Chain(parts)


def _read_adaptation(table: Table) -> str | tuple[str, ...]:
    """``adaptation``: a name, or a list of names."""
    if isinstance(table.data.get("adaptation"), list):
        names = table.names("adaptation")
        if not set(names) <= set(ADAPTATIONS) or len(set(names)) != len(names):
            table.fail("adaptation", f"names among {', '.join(ADAPTATIONS)}, none twice")
        return names
    return table.text("adaptation", "none", choices=("none", *ADAPTATIONS))
