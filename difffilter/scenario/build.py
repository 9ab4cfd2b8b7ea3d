"""The systems of a scenario made of their specifications: filters and baselines."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

from difffilter.adaptation import (
    Chain,
    InnovationMatching,
    MultipleFading,
    PredictionCorrection,
    StrongTracking,
)
from difffilter.adaptation.credibility import Credibility
from difffilter.adaptation.protocol import Adaptation
from difffilter.adaptation.scaling import InnovationScaling
from difffilter.baselines.bearing_lines import BearingLeastSquares
from difffilter.baselines.chan import ChanLeastSquares
from difffilter.baselines.chan_ekf import ChanEKF
from difffilter.baselines.least_squares import TaylorLeastSquares
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.fusion import Fusion
from difffilter.motions.blocks import ConstantVelocity
from difffilter.parameters.parameters import Number
from difffilter.robust.gate import Gate
from difffilter.robust.groups import channel_groups
from difffilter.robust.recovery import Recovery
from difffilter.scenario.sensing import SensorSpec
from difffilter.scenario.systems import MotionSpec, ParameterSpec, SystemSpec
from difffilter.sensors.builtin import TDOA, PositionSensor
from difffilter.weights.registry import weight_named

__all__ = ["System", "build_system"]

#: What a scenario calls a system: a recursive filter, or a baseline estimator.
System = Filter | TaylorLeastSquares | ChanLeastSquares | ChanEKF | BearingLeastSquares


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
