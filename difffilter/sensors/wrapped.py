"""Sensors around sensors: what errors that last, a delay and a noise law have in common."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants
from difffilter.sensors.information import common_columns
from difffilter.sensors.sensor import Inputs, Noise, Sensor

__all__ = ["Narrowed", "Wrapped", "bare", "inputs_of", "rewrapped", "seen"]


@dataclass(frozen=True)
class Wrapped:
    """A sensor that is another one with something more; by default nothing more.

    Attributes:
        sensor: the other one. Its name is the prefix of further parameters.
    """

    sensor: Sensor

    @property
    def name(self) -> str:
        """Prefix of the parameters: the sensor's name, or its first channel's."""
        return str(getattr(self.sensor, "name", self.sensor.channels[0]))

    @property
    def unit(self) -> str:
        """Of the measurement."""
        return str(getattr(self.sensor, "unit", "1"))

    @property
    def axes(self) -> int:
        """Position components of the state, where the sensor says so; else 0."""
        return int(getattr(self.sensor, "axes", 0))

    @property
    def channels(self) -> tuple[str, ...]:
        return self.sensor.channels

    @property
    def common_columns(self) -> int:
        """How many columns of noise common to channels there are."""
        return common_columns(self.sensor)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.sensor.parameters

    def prepare(self, values: Values) -> Constants:
        return self.sensor.prepare(values)

    def predict(self, state: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        return self.sensor.predict(state, inputs, constants)

    def observe(
        self, state: Tensor, deviations: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        return self.sensor.observe(state, deviations, inputs, constants)

    def residual(self, z: Tensor, predicted: Tensor) -> Tensor:
        return self.sensor.residual(z, predicted)

    def noise(self, mean: Tensor, inputs: Inputs, constants: Constants) -> Noise:
        return self.sensor.noise(mean, inputs, constants)

    def with_sensor(self, sensor: Sensor) -> Self:
        """The same around another sensor."""
        return replace(self, sensor=sensor)

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the columns of a log that it reads beside those of the sensor within."""
        return ()

    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        """Raise InputError if a known input is missing or is not what it can be."""
        check_inputs(self.sensor, inputs)

    def present(self, inputs: Inputs) -> Tensor | None:
        """Which channels (..., m) the inputs let count; None for all."""
        return None


@dataclass(frozen=True)
class Narrowed(Wrapped):
    """A sensor that sees the first ``size`` states: others follow them that it knows nothing of."""

    size: int = 0

    def predict(self, state: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        return self.sensor.predict(state[..., : self.size], inputs, constants)

    def observe(
        self, state: Tensor, deviations: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        n = self.size
        return self.sensor.observe(state[..., :n], deviations[..., :n, :], inputs, constants)

    def noise(self, mean: Tensor, inputs: Inputs, constants: Constants) -> Noise:
        return self.sensor.noise(mean[..., : self.size], inputs, constants)


def bare(sensor: Any) -> Any:
    """The sensor inside of all that is around it: what kinds of sensors are told apart by."""
    while isinstance(sensor, Wrapped):
        sensor = sensor.sensor
    return sensor


def rewrapped(sensor: Sensor, change: Callable[[Sensor], Sensor]) -> Sensor:
    """The same with the innermost sensor changed."""
    if isinstance(sensor, Wrapped):
        return sensor.with_sensor(rewrapped(sensor.sensor, change))
    return change(sensor)


def check_inputs(sensor: Sensor, inputs: Mapping[str, Tensor]) -> None:
    """Raise InputError if a known input that the sensor reads is missing or impossible."""
    check = getattr(sensor, "check_inputs", None)
    if check is not None:
        check(inputs)


def inputs_of(sensors: Sequence[Sensor]) -> tuple[str, ...]:
    """Names of the columns of a log that the sensors read, as far as they say so."""
    found: list[str] = []
    for sensor in sensors:
        part: Any = sensor
        while isinstance(part, Wrapped):
            found += part.inputs
            part = part.sensor
        found += getattr(part, "platform", ())
    return tuple(dict.fromkeys(found))


def seen(sensors: Sequence[Sensor], z: Tensor, inputs: Inputs) -> Tensor:
    """Measurements (..., m), NaN also where an input that the noise needs is missing."""
    parts, at, changed = [], 0, False
    for sensor in sensors:
        here = z[..., at : (at := at + len(sensor.channels))]
        part: Any = sensor
        while isinstance(part, Wrapped):
            present = part.present(inputs)
            if present is not None:
                here, changed = torch.where(present, here, torch.nan), True
            part = part.sensor
        parts.append(here)
    return torch.cat(parts, dim=-1) if changed else z


def named(sensor: Sensor, what: str) -> None:
    """InputError unless the sensor has a name for further parameters."""
    if not isinstance(getattr(sensor, "name", None), str):
        raise InputError(f"{what}: found a sensor without name, expected one with it")
