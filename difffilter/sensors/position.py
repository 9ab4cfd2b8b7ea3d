"""Sensors that measure functions of the position alone, and the simplest of them.

To add one, write ``measure``: the error-free measurement and its gradient towards the
position.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from difffilter.core.linalg import components, product
from difffilter.errors import InputError
from difffilter.parameters.parameters import Number, Parameter, Values
from difffilter.parameters.values import Constants
from difffilter.sensors.sensor import Inputs, Noise, NoiseAndBias, difference

__all__ = ["Position", "PositionSensor"]


@dataclass(frozen=True, kw_only=True)
class PositionSensor:
    """A sensor whose measurement depends on the position only.

    Attributes:
        name: prefix of its parameters.
        channels: names of its channels; by default the name with numbers.
        axes: position components of the state, its first entries.
        sigma: standard deviation in ``unit`` (one, or one per channel), or covariance.
        bias: in ``unit``, added to every channel's prediction, or one per channel.
        unit: of the measurement.

    Raises:
        InputError: a number of channels that does not fit.
    """

    unit: ClassVar[str] = "m"

    name: str = "sensor"
    channels: tuple[str, ...] = ()
    axes: int = 2
    sigma: Number = 1.0
    bias: Number = 0.0

    def __post_init__(self) -> None:
        if not self.channels:
            object.__setattr__(self, "channels", self.default_channels())
        count = len(self.default_channels())
        if len(self.channels) != count:
            raise InputError(f"{self.name}.channels: found {len(self.channels)}, expected {count}")

    def default_channels(self) -> tuple[str, ...]:
        """One name per channel."""
        return tuple(f"{self.name}_{i + 1}" for i in range(self.axes))

    @property
    def base(self) -> NoiseAndBias:
        """The declarations that every sensor shares."""
        return NoiseAndBias(self.name, self.channels, self.sigma, self.bias, self.unit)

    @property
    def common_columns(self) -> int:
        """How many columns of noise common to channels there are."""
        return self.base.common_columns

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.base.parameters

    def prepare(self, values: Values) -> Constants:
        return self.base.prepare(values)

    def noise(self, mean: Tensor, inputs: Inputs, constants: Constants) -> Noise:
        return self.base.noise(constants)

    def measure(
        self, position: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        """Error-free h (..., m) and its gradient towards the position (..., m, axes)."""
        raise NotImplementedError

    def predict(self, state: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        h, _ = self.measure(components(state, self.axes), inputs, constants)
        return h + Constants.of(constants)[f"{self.name}.bias"]

    def observe(
        self, state: Tensor, deviations: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        h, gradient = self.measure(components(state, self.axes), inputs, constants)
        predicted = h + Constants.of(constants)[f"{self.name}.bias"]
        return predicted, product(gradient, deviations)

    def residual(self, z: Tensor, predicted: Tensor) -> Tensor:
        return difference(z, predicted)


@dataclass(frozen=True, kw_only=True)
class Position(PositionSensor):
    """Position measured directly, m, one channel per axis: h(x) = position."""

    name: str = "position"

    def measure(
        self, position: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        unit = torch.eye(self.axes, dtype=position.dtype, device=position.device)
        return position, unit.expand(*position.shape[:-1], self.axes, self.axes)
