"""The systems of a scenario made of their specifications: filters and baselines."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from difffilter.adaptation.registry import Host
from difffilter.baselines.least_squares import Snapshot
from difffilter.baselines.registry import BASELINES, Given
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.motions.blocks import ConstantVelocity
from difffilter.parameters.parameters import Number
from difffilter.robust.groups import channel_groups
from difffilter.scenario.options import OPTIONS
from difffilter.scenario.sensing import SensorSpec
from difffilter.scenario.systems import MotionSpec, ParameterSpec, SystemSpec
from difffilter.sensors.builtin import TDOA
from difffilter.weights.registry import WEIGHTS

__all__ = ["System", "build_system"]

#: What a scenario calls a system: a recursive filter, or a baseline estimator.
System = Filter | Snapshot


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

    def moving() -> ConstantVelocity:
        level = value(motion.parameter)
        if level is None:
            raise InputError(f"needs [parameters.{motion.parameter}], found none")
        return motion.build(axes, level)

    given = Given(
        sensors=models,
        axes=axes,
        moving=moving,
        start_sigma=value("start.sigma"),
        known_velocity=velocity,
    )
    try:
        bare = (
            _filter(spec, given) if spec.estimator == "filter" else BASELINES[spec.estimator](given)
        )
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


def _filter(spec: SystemSpec, given: Given) -> Filter:
    """The recipe alone."""
    counts = [len(sensor.channels) for sensor in given.sensors]
    channels = [c for sensor in given.sensors for c in sensor.channels]
    host = Host(
        WEIGHTS[spec.options["weight"]], channel_groups("sensor", channels, counts), given.axes
    )
    options = {key: option.make(spec.options[key], host) for key, option in OPTIONS.items()}
    return Filter(given.motion, given.sensors, start_sigma=given.start_sigma, **options)
