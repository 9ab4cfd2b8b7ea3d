"""The systems of a scenario made of what its file says: filters and baselines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any

from difffilter.adaptation.registry import Host
from difffilter.baselines.least_squares import Snapshot
from difffilter.baselines.registry import BASELINES, Given
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.fusion import Fusion
from difffilter.filters.mixture import Mixture
from difffilter.filters.recipe import Recipe
from difffilter.parameters.parameters import Number
from difffilter.robust.groups import channel_groups
from difffilter.scenario.options import OPTIONS
from difffilter.scenario.sensing import SensorSpec
from difffilter.scenario.systems import MotionSpec, ParameterSpec, SystemSpec
from difffilter.scenario.table import Table
from difffilter.sensors.builtin import TDOA, PositionSensor
from difffilter.weights.registry import WEIGHTS

__all__ = ["System", "build_system"]

#: What a scenario calls a system: a recursive filter, or a baseline estimator.
System = Recipe | Snapshot


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
    parameters = _own_values(spec.where, spec.name, spec.values, parameters)

    def value(name: str) -> Number | None:
        return parameters[name].value if name in parameters else None

    def where(text: object) -> InputError:
        return InputError(f"{spec.where}: {text}")

    chosen = [sensors[name] for name in spec.sensors]
    models = tuple(
        sensor.for_filter({n: p.value for n, p in parameters.items()}, spec.common_noise)
        for sensor in chosen
    )
    if spec.common_noise and not any(isinstance(model, TDOA) for model in models):
        raise where("common_noise: found no TDOA sensor, expected one with it")
    given = Given(
        sensors=models,
        axes=axes,
        moving=partial(motion.build, axes, parameters),
        start_sigma=value("start.sigma"),
        known_velocity=velocity,
    )
    try:
        bare = _bare(spec, given, motion, parameters)
        own = bare.declarations
    except InputError as error:
        raise where(error) from None
    for name in spec.values:
        if name not in own:
            raise where(f"values: found {name}, expected one of {', '.join(own)}")
    declared = {name: p.declare(own[name]) for name, p in parameters.items() if name in own}
    whole: Any = bare  # a dataclass, whichever it is
    return replace(whole, overrides=declared)  # type: ignore[no-any-return]


def _own_values(
    where: str, name: str, values: Mapping[str, Number], parameters: Mapping[str, ParameterSpec]
) -> Mapping[str, ParameterSpec]:
    """The scenario's parameters with the own values of a system or mode in their place."""
    where = f"{where}.values"
    blank = ParameterSpec(where, 0.0, "", "", tuned=None, prior=None)
    own = {
        key: replace(parameters.get(key, blank), where=f"{where}.{key}", value=value, source=name)
        for key, value in values.items()
    }
    return {**parameters, **own}


def _bare(
    spec: SystemSpec,
    given: Given,
    motion: MotionSpec,
    parameters: Mapping[str, ParameterSpec],
) -> System:
    """The recipe or baseline before the scenario's values are declared."""
    if spec.estimator != "filter":
        for sensor in given.sensors:
            if not isinstance(sensor, PositionSensor):
                raise InputError(
                    f"sensors: found {sensor.channels[0]}, a sensor of more than the position, "
                    f"expected none with estimator = {spec.estimator!r}"
                )
        return BASELINES[spec.estimator](given)
    if spec.modes:
        return _mixture(spec, given, motion, parameters)
    if spec.fusion != "none":
        return _fusion(spec, given)
    return _filter(spec.options, given)


def _fusion(spec: SystemSpec, given: Given) -> Fusion:
    """A subsystem for each sensor; InputError for options that belong to a filter."""
    blank = Table({}, spec.where)
    for key, option in OPTIONS.items():
        if key != "linearise" and spec.options[key] != option.read(blank, key):
            raise InputError(f"{key}: expected no weight, gate or other option with fusion")
    return Fusion(
        given.motion,
        given.sensors,
        axes=given.axes,
        linearise=spec.options["linearise"],
        start_sigma=given.start_sigma,
    )


def _filter(wanted: Mapping[str, Any], given: Given) -> Filter:
    """The recipe alone."""
    counts = [len(sensor.channels) for sensor in given.sensors]
    channels = [c for sensor in given.sensors for c in sensor.channels]
    host = Host(WEIGHTS[wanted["weight"]], channel_groups("sensor", channels, counts), given.axes)
    options = {key: option.make(wanted[key], host) for key, option in OPTIONS.items()}
    return Filter(given.motion, given.sensors, start_sigma=given.start_sigma, **options)


def _mixture(
    spec: SystemSpec,
    given: Given,
    motion: MotionSpec,
    parameters: Mapping[str, ParameterSpec],
) -> Mixture:
    """The filters of a system's modes: each with its motion, options and published values."""
    modes = {}
    for mode in spec.modes:
        own = _own_values(f"{spec.where}.modes.{mode.name}", mode.name, mode.values, parameters)
        kind = mode.motion or motion
        part = replace(given, start_sigma=None, moving=partial(kind.build, given.axes, own))
        try:
            filter = _filter(mode.options, part)
        except InputError as error:
            raise InputError(f"modes.{mode.name}: {error}") from None
        declared = {
            name: p.declare(filter.declarations[name])
            for name, p in own.items()
            if name in filter.declarations
        }
        modes[mode.name] = replace(filter, overrides=declared)
    return Mixture(modes, own=spec.own, start_sigma=given.start_sigma)
