"""Noise laws: how a sensor's noise follows a column of the log, or the distance."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from difffilter.errors import InputError, LogError
from difffilter.parameters.constraints import Bounded, Positive
from difffilter.parameters.parameters import Number, Parameter, Values, as_number
from difffilter.parameters.values import Constants
from difffilter.sensors.sensor import Inputs, Noise, Sensor
from difffilter.sensors.wrapped import Wrapped, bare, named

__all__ = ["LAWS", "Varying", "followed", "varies"]

#: What the sensor's sigma a becomes with a column c and a coefficient b, by name: the formula,
#: what of c is impossible, and the coefficient's parameter.
LAWS = {
    "times": ("a c", "a number above 0", ""),
    "root": ("sqrt(a^2 + (b c)^2)", "a number", "slope"),
    "linear": ("a + b c", "a number of 0 or more", "slope"),
    "exponential": ("a exp(-c / b)", "a number", "decay"),
}


@dataclass(frozen=True)
class Varying(Wrapped):
    """A sensor whose noise is not the same in each row.

    With a = ``NAME.sigma`` and c the column, or the distance from the station:

    * ``times``: a c. An accuracy in the log is c, and a says how far to believe it;
    * ``root``: sqrt(a^2 + (b c)^2), b = ``NAME.slope``;
    * ``linear``: a + b c, b = ``NAME.slope``: noise that grows with the range;
    * ``exponential``: a exp(-c / b), b = ``NAME.decay`` in the column's unit: carrier-to-noise.

    Where the column is missing (NaN), so is the measurement. Every coefficient can be tuned.

    Attributes:
        sensor: with a name and a parameter ``NAME.sigma``.
        law: one of the above.
        column: name of a known input, or one for each channel; empty for the distance, of
            sensors with one channel for each station.
        coefficient: published b, one number or one per channel; unused by ``times``.

    Raises:
        InputError: an unknown law; a column, coefficient or sensor that does not fit.

    Example:
        >>> from difffilter import Position, Varying
        >>> fix = Varying(Position(name="fix", sigma=0.5), "root", "hdop", coefficient=1.2)
        >>> ", ".join(p.name for p in fix.parameters)
        'fix.sigma, fix.bias, fix.slope'
    """

    law: str = "times"
    column: str | tuple[str, ...] = ()
    coefficient: Number | None = None

    def __post_init__(self) -> None:
        named(self.sensor, "noise law")
        if isinstance(self.column, str):
            object.__setattr__(self, "column", (self.column,))
        if self.law not in LAWS:
            raise InputError(
                f"{self.name}: found law {self.law!r:.40}, expected one of {', '.join(LAWS)}"
            )
        if len(self.column) not in (0, 1, len(self.channels)):
            raise InputError(
                f"{self.name}: found {len(self.column)} columns, expected one, or one for each of "
                f"{len(self.channels)} channels"
            )
        inner = bare(self.sensor)
        stations = getattr(inner, "stations", ()) if hasattr(inner, "distances") else ()
        if not self.column and len(stations) != len(self.channels):
            raise InputError(
                f"{self.name}: found no column, expected one: distances are those of sensors with "
                "a channel for each station"
            )
        if (self.coefficient is None) is not (self.field == ""):
            expected = f"a coefficient, {self.name}.{self.field}" if self.field else "none"
            raise InputError(f"{self.name}: coefficient with law {self.law!r}: expected {expected}")
        sigma = next((p for p in self.sensor.parameters if p.name == f"{self.name}.sigma"), None)
        if sigma is None or (sigma.tensor().dim() > 1 and self.law in ("root", "linear")):
            raise InputError(
                f"{self.name}: law {self.law!r}: expected a sensor with a sigma that is one number "
                "or one per channel"
            )

    @property
    def field(self) -> str:
        """The coefficient's parameter, without the sensor's name; empty for none."""
        return LAWS[self.law][2]

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        if self.coefficient is None:
            return self.sensor.parameters
        value, m = as_number(self.coefficient), len(self.channels)
        shape = torch.tensor(value).shape
        if shape not in ((), (m,)):
            raise InputError(
                f"{self.name}.{self.field}: found shape {list(shape)}, expected one number or "
                f"{m} numbers"
            )
        what = "the distance" if not self.column else "column " + ", ".join(self.column)
        size = float(torch.tensor(value, dtype=torch.float64).abs().max())
        own = Parameter(
            f"{self.name}.{self.field}",
            value,
            Positive() if self.field == "decay" else Bounded(0.0, scale=size or 1.0),
            "1" if self.column else f"{self.unit}/m",
            labels=self.channels if shape else (),
            meaning=f"noise {LAWS[self.law][0]}, c {what}: b",
            noise=True,
        )
        return (*self.sensor.parameters, own)

    def prepare(self, values: Values) -> Constants:
        """Coefficient and sigma, (m,) each."""
        found, m = self.sensor.prepare(values), len(self.channels)
        if not self.field:
            return found
        more = {f"{self.name}.{self.field}": values[f"{self.name}.{self.field}"].expand(m)}
        sigma = values[f"{self.name}.sigma"]
        return found | more | ({f"{self.name}.level": sigma.expand(m)} if sigma.dim() < 2 else {})

    def _driving(self, mean: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        """c, (..., m) or (..., 1); 1 where it is missing."""
        if not self.column:
            inner: Any = bare(self.sensor)
            distances: Tensor = inner.distances(mean, inputs, constants)
            return distances
        c = torch.stack([inputs[name] for name in self.column], dim=-1)
        return torch.where(torch.isnan(c), 1.0, c)

    def noise(self, mean: Tensor, inputs: Inputs, constants: Constants) -> Noise:
        noise, constants = self.sensor.noise(mean, inputs, constants), Constants.of(constants)
        c = self._driving(mean, inputs, constants)
        if self.law == "times":
            factor = c
        else:
            b = constants[f"{self.name}.{self.field}"]
            if self.law == "exponential":
                factor = torch.exp(-c / b)
            else:
                relative = b * c / constants[f"{self.name}.level"]
                root = self.law == "root"
                factor = (1.0 + relative.square()).sqrt() if root else 1.0 + relative
        return noise.times(factor.expand(*factor.shape[:-1], len(self.channels)))

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(self.column)

    def present(self, inputs: Inputs) -> Tensor | None:
        if not self.column:
            return None
        known = [~torch.isnan(inputs[name]) for name in self.column]
        return torch.stack(known, dim=-1)

    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        """Raise InputError if a column is missing, LogError if it holds what cannot be."""
        super().check_inputs(inputs)
        for name in self.column:
            if name not in inputs:
                raise InputError(f"log: found no input {name}, expected the column of {self.name}")
            c = inputs[name]
            bad = torch.isinf(c)
            if self.law in ("times", "linear"):
                bad = bad | (c < 0.0 if self.law == "linear" else c <= 0.0)
            if bool(bad.any()):
                row = int(bad.nonzero()[0, 0]) if bad.dim() else 0
                raise LogError(
                    f"log: input {name}, row {row + 1}: found {float(c[bad].reshape(-1)[0]):g}, "
                    f"expected {LAWS[self.law][1]} for the noise of {self.name}, or none"
                )


def varies(sensor: Sensor) -> bool:
    """Whether there is a noise law around the sensor."""
    while isinstance(sensor, Wrapped):
        if isinstance(sensor, Varying):
            return True
        sensor = sensor.sensor
    return False


def followed(sensors: Sequence[Sensor]) -> tuple[str, ...]:
    """Names of the columns that noise laws follow."""
    found: list[str] = []
    for sensor in sensors:
        while isinstance(sensor, Wrapped):
            found += sensor.column if isinstance(sensor, Varying) else ()
            sensor = sensor.sensor
    return tuple(dict.fromkeys(found))
