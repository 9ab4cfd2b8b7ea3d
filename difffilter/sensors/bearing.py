"""Bearings: the direction in which a station, fixed or on a platform, sees the target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.parameters.values import Constants
from difffilter.sensors.sensor import Inputs, wrap
from difffilter.sensors.stations import StationSensor

__all__ = ["Bearing"]


@dataclass(frozen=True, kw_only=True)
class Bearing(StationSensor):
    """Bearing atan2(y - y_s, x - x_s) from each station, in rad, from the x axis towards y.

    Residuals are wrapped to [-pi, pi). One station at the origin, the default, is the form
    for a state relative to the observer (paper 1); with ``platform`` the state is absolute and
    the log tells where the observer is.

    The gradient is (-(y - y_s), x - x_s) / d^2 (paper 1, eq. 3, whose second entry has the
    wrong sign); at a station itself it is zero.

    Attributes:
        name: prefix of ``NAME.sigma`` and ``NAME.bias``, both in rad.
        stations: (x, y) of each, m; relative to the platform where there is one.

    Raises:
        InputError: a state of other than two axes.
    """

    unit: ClassVar[str] = "rad"

    name: str = "bearing"
    stations: Sequence[Sequence[float]] = ((0.0, 0.0),)

    def __post_init__(self) -> None:
        if self.axes != 2:
            raise InputError(f"{self.name}: found {self.axes} axes, expected 2")
        super().__post_init__()

    def default_channels(self) -> tuple[str, ...]:
        return (self.name,) if len(self.stations) == 1 else super().default_channels()

    def measure(
        self, position: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        apart, _ = self.apart(position, inputs, constants)
        x, y = apart[:, 0], apart[:, 1]
        square = x.square() + y.square()
        away = square > 0.0
        inverse = torch.where(away, 1.0 / torch.where(away, square, 1.0), 0.0)
        # atan2 has no gradient at (0, 0): see the target straight ahead there.
        bearing = torch.atan2(torch.where(away, y, 0.0), torch.where(away, x, 1.0))
        gradient = torch.stack([-y * inverse, x * inverse], dim=1)
        return bearing.movedim(0, -1), gradient.movedim((0, 1), (-2, -1))

    def residual(self, z: Tensor, predicted: Tensor) -> Tensor:
        return wrap(z, predicted)
