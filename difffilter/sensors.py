"""Built-in sensors with analytic Jacobians: position, range, time difference of arrival.

Each measures functions of the position alone. To add one, write ``measure``: the
error-free measurement and its gradient towards the position.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.constraints import Positive
from difffilter.errors import InputError
from difffilter.linalg import components, positive_sqrt, product
from difffilter.parameters import Number, Parameter, Values, as_number
from difffilter.sensor import Inputs, Noise, NoiseAndBias, difference

__all__ = ["TDOA", "Position", "Range"]


@dataclass(frozen=True, kw_only=True)
class PositionSensor:
    """A sensor whose measurement depends on the position only.

    Attributes:
        name: prefix of its parameters.
        channels: names of its channels; by default the name with numbers.
        axes: position components of the state, its first entries.
        sigma: standard deviation in m (one, or one per channel), or covariance in m^2.
        bias: in m, added to every channel's prediction, or one per channel.
    """

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
        return NoiseAndBias(self.name, self.channels, self.sigma, self.bias, "m")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.base.parameters

    def prepare(self, values: Values) -> dict[str, Tensor]:
        return self.base.prepare(values)

    def noise(self, constants: Values) -> Noise:
        return self.base.noise(constants)

    def measure(self, position: Tensor, inputs: Inputs, constants: Values) -> tuple[Tensor, Tensor]:
        """Error-free h (..., m) and its gradient towards the position (..., m, axes)."""
        raise NotImplementedError

    def predict(self, state: Tensor, inputs: Inputs, constants: Values) -> Tensor:
        h, _ = self.measure(components(state, self.axes), inputs, constants)
        return h + constants[f"{self.name}.bias"]

    def observe(
        self, state: Tensor, deviations: Tensor, inputs: Inputs, constants: Values
    ) -> tuple[Tensor, Tensor]:
        h, gradient = self.measure(components(state, self.axes), inputs, constants)
        predicted = h + constants[f"{self.name}.bias"]
        return predicted, product(gradient, deviations)

    def residual(self, z: Tensor, predicted: Tensor) -> Tensor:
        return difference(z, predicted)


@dataclass(frozen=True, kw_only=True)
class Position(PositionSensor):
    """Position measured directly, one channel per axis: h(x) = position."""

    name: str = "position"

    def measure(self, position: Tensor, inputs: Inputs, constants: Values) -> tuple[Tensor, Tensor]:
        unit = torch.eye(self.axes, dtype=position.dtype, device=position.device)
        return position, unit.expand(*position.shape[:-1], self.axes, self.axes)


@dataclass(frozen=True, kw_only=True)
class Range(PositionSensor):
    """Distance to each station.

    Stations have one coordinate per axis of the state; one more is their height, and then
    the state's own height is ``height``, known, and the distance is three-dimensional.
    A log's input ``NAME.stations`` (..., stations, coordinates) overrides the positions
    per trajectory or per step. At a station itself the gradient is zero.
    """

    name: str = "range"
    stations: Sequence[Sequence[float]]
    height: float = 0.0

    def __post_init__(self) -> None:
        object.__setattr__(self, "stations", as_number(self.stations))
        lengths = {len(station) for station in self.stations}
        if len(lengths) != 1 or not lengths <= {self.axes, self.axes + 1}:
            raise InputError(
                f"{self.name}.stations: found {sorted(lengths)} coordinates, expected "
                f"{self.axes}, or {self.axes + 1} with the height, for every station"
            )
        super().__post_init__()

    def default_channels(self) -> tuple[str, ...]:
        return tuple(f"{self.name}_{i + 1}" for i in range(len(self.stations)))

    def prepare(self, values: Values) -> dict[str, Tensor]:
        sigma = values[f"{self.name}.sigma"]
        stations = torch.tensor(self.stations, dtype=sigma.dtype, device=sigma.device)
        return super().prepare(values) | {f"{self.name}.stations": stations}

    def measure(self, position: Tensor, inputs: Inputs, constants: Values) -> tuple[Tensor, Tensor]:
        key = f"{self.name}.stations"
        stations = inputs[key] if key in inputs else constants[key]
        # Leading dimensions broadcast: first make their number equal.
        rank = max(position.dim(), stations.dim() - 1)
        position = position[(None,) * (rank - position.dim())]
        stations = stations[(None,) * (rank + 1 - stations.dim())]
        # Stations and coordinates first, trajectories last in memory.
        stations = stations.movedim((-2, -1), (0, 1))
        apart = position.movedim(-1, 0) - stations[:, : self.axes]
        square = apart.square().sum(1)
        if stations.shape[1] > self.axes:
            square = square + (self.height - stations[:, self.axes]).square()
        distance = positive_sqrt(square)
        # Divide by 1 at a station: the gradient of the unit vector stays finite there.
        length = torch.where(square > 0, distance, 1.0)
        unit = apart * length.reciprocal().unsqueeze(1)
        return self.of(distance).movedim(0, -1), self.of(unit).movedim((0, 1), (-2, -1))

    def of(self, stations: Tensor) -> Tensor:
        """A quantity per channel from one per station (the first dimension)."""
        return stations


@dataclass(frozen=True, kw_only=True)
class TDOA(Range):
    """Time difference of arrival as range difference r_i - r_1 to the first station.

    Channels are numbered by station, from 2. Noise is independent per difference
    (``NAME.sigma``, as paper 3 has it); with ``common_sigma`` the reference station's own
    noise, common to all differences, is added: R = sigma^2 I + common_sigma^2 1 1^T.
    """

    name: str = "tdoa"
    common_sigma: float | None = None

    def default_channels(self) -> tuple[str, ...]:
        return tuple(f"{self.name}_{i + 1}" for i in range(1, len(self.stations)))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        if self.common_sigma is None:
            return self.base.parameters
        meaning = "noise of the reference station, common to all differences"
        common = Parameter(
            f"{self.name}.common_sigma", self.common_sigma, Positive(), "m", meaning=meaning
        )
        return (*self.base.parameters, common)

    def prepare(self, values: Values) -> dict[str, Tensor]:
        constants = super().prepare(values)
        if self.common_sigma is not None:
            sigma = values[f"{self.name}.common_sigma"]
            column = sigma.expand(len(self.channels), 1)
            constants[f"{self.name}.common"] = torch.cat(
                [constants[f"{self.name}.common"], column], dim=-1
            )
            constants[f"{self.name}.total"] = constants[f"{self.name}.total"] + sigma.square()
        return constants

    def of(self, stations: Tensor) -> Tensor:
        return stations[1:] - stations[:1]
