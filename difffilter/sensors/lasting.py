"""Errors of a sensor that last: states of their own, one for each channel or one for all."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Number, Parameter, Values, as_number
from difffilter.parameters.values import Constants
from difffilter.sensors.sensor import Inputs, Noise
from difffilter.sensors.wrapped import Wrapped, named

__all__ = ["ErrorStates", "Lasting", "Place"]


class Place(NamedTuple):
    """Where the error states stand: behind ``size`` others, at ``at``."""

    size: int
    at: int


class ErrorStates(NamedTuple):
    """Error states that share parameters: their names, and those of sigma and time."""

    states: tuple[str, ...]
    sigma: str
    time: str


@dataclass(frozen=True)
class Lasting(Wrapped):
    """A sensor with errors that go on in time: z = h(x) + e_own + e_common + white noise.

    Each error is a first-order Gauss-Markov process of standard deviation sigma and correlation
    time tau: e' = exp(-dt / tau) e + w, w of variance sigma^2 (1 - exp(-2 dt / tau)) (Gelb,
    Applied Optimal Estimation, 1974, section 3.8). A filter with such a sensor has the errors as
    further states, which start at 0 with their sigma. ``own`` is one error for each channel,
    ``CHANNEL_error``; ``common`` one that all channels share, ``NAME_error``.

    White noise and errors tell apart what is new in each row and what goes on: a filter that
    takes a lasting error as new in each row averages it away and is far too sure.

    Attributes:
        sensor: with a name, the prefix of the parameters below.
        own: published sigma (unit of the measurement) and time (s), each one number or one per
            channel: parameters ``NAME.own_error`` and ``NAME.own_time``; None for none.
        common: the same for the one that all share: ``NAME.common_error``,
            ``NAME.common_time``, one number each.
        place: set by the filter. Without it the errors count as noise of each row and channel:
            what starts and scores of single measurements ask for.

    Raises:
        InputError: neither own nor common, a sensor without name.

    Example:
        >>> from difffilter import ConstantVelocity, Filter, Lasting, Range
        >>> anchors = Range(stations=[(0, 0), (9, 0), (0, 9)], sigma=0.1)
        >>> Filter(ConstantVelocity(2), (Lasting(anchors, common=(0.2, 1.4)),)).states
        ('x', 'y', 'vx', 'vy', 'range_error')
    """

    own: tuple[Number, Number] | None = None
    common: tuple[float, float] | None = None
    place: Place | None = None

    def __post_init__(self) -> None:
        named(self.sensor, "errors that last")
        if self.own is None and self.common is None:
            raise InputError(f"{self.name}: found no error that lasts, expected own or common")
        for what, pair in (("own", self.own), ("common", self.common)):
            if pair is not None and len(pair) != 2:
                raise InputError(f"{self.name}.{what}: expected a sigma and a time")

    @property
    def errors(self) -> tuple[ErrorStates, ...]:
        """Own ones first."""
        found, name = [], self.name
        if self.own is not None:
            states = tuple(f"{channel}_error" for channel in self.channels)
            found.append(ErrorStates(states, f"{name}.own_error", f"{name}.own_time"))
        if self.common is not None:
            found.append(
                ErrorStates((f"{name}_error",), f"{name}.common_error", f"{name}.common_time")
            )
        return tuple(found)

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        own = []
        for what, pair in (("own", self.own), ("common", self.common)):
            if pair is not None:
                own += [
                    self._declared(what, "error", pair[0]),
                    self._declared(what, "time", pair[1]),
                ]
        return (*self.sensor.parameters, *own)

    def _declared(self, what: str, field: str, value: Number) -> Parameter:
        value, m = as_number(value), len(self.channels)
        shape = torch.tensor(value).shape
        name = f"{self.name}.{what}_{field}"
        if shape not in ((), (m,)) or (shape and what == "common"):
            expected = "one number" + (f" or {m} numbers" if what == "own" else "")
            raise InputError(f"{name}: found shape {list(shape)}, expected {expected}")
        whose = "each channel's own" if what == "own" else "common to all channels"
        kind = "standard deviation" if field == "error" else "correlation time"
        return Parameter(
            name,
            value,
            Positive(),
            self.unit if field == "error" else "s",
            labels=self.channels if shape else (),
            meaning=f"error that lasts, {whose}: {kind}",
            noise=field == "error",
        )

    def prepare(self, values: Values) -> Constants:
        """The sensor's constants, and the variance of each channel's errors (m,)."""
        sigmas = [values[part.sigma] for part in self.errors]
        variance = torch.stack([s.square().expand(len(self.channels)) for s in sigmas]).sum(0)
        return self.sensor.prepare(values) | {f"{self.name}.lasting": variance}

    def _added(self, state: Tensor) -> Tensor:
        """Sum of the errors of each channel: (..., m), of entries or rows (..., n) of a state."""
        assert self.place is not None
        at, m = self.place.at, len(self.channels)
        if self.own is None:
            return state[..., at : at + 1]
        own = state[..., at : at + m]
        return own if self.common is None else own + state[..., at + m : at + m + 1]

    def predict(self, state: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        if self.place is None:
            return self.sensor.predict(state, inputs, constants)
        predicted = self.sensor.predict(state[..., : self.place.size], inputs, constants)
        return predicted + self._added(state)

    def observe(
        self, state: Tensor, deviations: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        if self.place is None:
            return self.sensor.observe(state, deviations, inputs, constants)
        n = self.place.size
        value, z = self.sensor.observe(state[..., :n], deviations[..., :n, :], inputs, constants)
        return value + self._added(state), z + self._added(deviations.mT).mT

    def noise(self, mean: Tensor, inputs: Inputs, constants: Constants) -> Noise:
        if self.place is not None:
            return self.sensor.noise(mean[..., : self.place.size], inputs, constants)
        found, constants = self.sensor.noise(mean, inputs, constants), Constants.of(constants)
        more = constants[f"{self.name}.lasting"]
        return Noise(found.independent + more, found.common, found.total + more)
