"""Sensors with stations: range and time difference of arrival; stations may ride a platform."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.core.linalg import components, positive_sqrt
from difffilter.errors import InputError
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter, Values, as_number
from difffilter.parameters.values import Constants
from difffilter.sensors.position import PositionSensor
from difffilter.sensors.sensor import Inputs

__all__ = ["TDOA", "Range", "StationSensor"]


@dataclass(frozen=True, kw_only=True)
class StationSensor(PositionSensor):
    """A sensor whose channels depend on where the target is relative to stations.

    Attributes:
        stations: coordinates in m, one per axis of the state. A log's input ``NAME.stations``
            (..., stations, coordinates) overrides them per trajectory or per step.
        platform: names of known scalar inputs (columns of a log), one per coordinate: the
            position of a moving platform, to which the stations are relative (not turning
            with it). Empty for fixed stations.
    """

    stations: Sequence[Sequence[float]]
    platform: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "stations", as_number(self.stations))
        lengths = {len(station) for station in self.stations}
        if len(lengths) != 1 or not lengths <= set(self.coordinates()):
            raise InputError(
                f"{self.name}.stations: found {sorted(lengths)} coordinates, expected "
                f"{self.expected_coordinates()}, for every station"
            )
        if self.platform and {len(self.platform)} != lengths:
            raise InputError(
                f"{self.name}.platform: found {len(self.platform)} inputs, "
                f"expected {min(lengths)}, one per coordinate of a station"
            )
        super().__post_init__()

    def coordinates(self) -> tuple[int, ...]:
        """How many coordinates a station may have."""
        return (self.axes,)

    def expected_coordinates(self) -> str:
        """The same in words."""
        return f"{self.axes}"

    def default_channels(self) -> tuple[str, ...]:
        return tuple(f"{self.name}_{i + 1}" for i in range(len(self.stations)))

    def prepare(self, values: Values) -> Constants:
        sigma = values[f"{self.name}.sigma"]
        stations = torch.tensor(self.stations, dtype=sigma.dtype, device=sigma.device)
        return super().prepare(values) | {f"{self.name}.stations": stations}

    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        """Raise InputError if the platform's position is not among the inputs."""
        for name in self.platform:
            if name not in inputs:
                raise InputError(f"log: found no input {name}, expected the platform's position")

    def located(self, inputs: Inputs, constants: Constants) -> Tensor:
        """(..., stations, coordinates), where the stations are."""
        key = f"{self.name}.stations"
        stations = inputs[key] if key in inputs else Constants.of(constants)[key]
        if not self.platform:
            return stations
        self.check_inputs(inputs)
        platform = torch.stack([inputs[name] for name in self.platform], dim=-1)
        return stations + platform.unsqueeze(-2)

    def apart(
        self, position: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        """Target minus stations along the axes (stations, axes, ...), and the stations.

        Stations and coordinates come first and trajectories last in memory.
        """
        stations = self.located(inputs, constants)
        # Leading dimensions broadcast: first make their number equal.
        rank = max(position.dim(), stations.dim() - 1)
        position = position[(None,) * (rank - position.dim())]
        stations = stations[(None,) * (rank + 1 - stations.dim())]
        stations = stations.movedim((-2, -1), (0, 1))
        return position.movedim(-1, 0) - stations[:, : self.axes], stations

    def distances(self, state: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        """(..., stations), from each station along the axes of the state, m."""
        apart, _ = self.apart(components(state, self.axes), inputs, constants)
        return positive_sqrt(apart.square().sum(1)).movedim(0, -1)


@dataclass(frozen=True, kw_only=True)
class Range(StationSensor):
    """Distance to each station.

    Stations may have one coordinate more than the state has axes: their height. Then the
    state's own height is ``height``, known, and the distance is three-dimensional. At a
    station itself the gradient is zero.
    """

    name: str = "range"
    height: float = 0.0

    def coordinates(self) -> tuple[int, ...]:
        return (self.axes, self.axes + 1)

    def expected_coordinates(self) -> str:
        return f"{self.axes}, or {self.axes + 1} with the height"

    def measure(
        self, position: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        apart, stations = self.apart(position, inputs, constants)
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

    def __post_init__(self) -> None:
        if len(self.stations) < 2:
            raise InputError(
                f"{self.name}.stations: found {len(self.stations)}, expected two or more, the "
                "reference first"
            )
        super().__post_init__()

    def default_channels(self) -> tuple[str, ...]:
        return tuple(f"{self.name}_{i + 1}" for i in range(1, len(self.stations)))

    @property
    def common_columns(self) -> int:
        return super().common_columns + (self.common_sigma is not None)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        if self.common_sigma is None:
            return self.base.parameters
        meaning = "noise of the reference station, common to all differences"
        common = Parameter(
            f"{self.name}.common_sigma", self.common_sigma, Positive(), "m", meaning=meaning,
            noise=True,
        )  # fmt: skip
        return (*self.base.parameters, common)

    def prepare(self, values: Values) -> Constants:
        constants, name = super().prepare(values), self.name
        if self.common_sigma is None:
            return constants
        sigma = values[f"{name}.common_sigma"]
        column = sigma.expand(len(self.channels), 1)
        return constants | {
            f"{name}.common": torch.cat([constants[f"{name}.common"], column], dim=-1),
            f"{name}.total": constants[f"{name}.total"] + sigma.square(),
        }

    def of(self, stations: Tensor) -> Tensor:
        return stations[1:] - stations[:1]
