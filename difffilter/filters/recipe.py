"""What every estimator declares, and what every recursive one does besides."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.errors import InputError
from difffilter.motions.protocol import Motion
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import (
    Number,
    Parameter,
    Values,
    as_number,
    check_values,
    declare,
    published_values,
)
from difffilter.parameters.values import Constants
from difffilter.sensors.information import common_noise
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.stations import StationSensor

__all__ = ["RULES", "Declared", "Modelled", "Recipe", "declared_start"]

RULES = ("taylor", "cubature")


class Declared(ABC):
    """What an estimator of any kind tells about itself: states, channels, parameters."""

    @property
    @abstractmethod
    def states(self) -> tuple[str, ...]:
        """Names of the n states, the position first."""

    @property
    @abstractmethod
    def channels(self) -> tuple[str, ...]:
        """Names of the m channels, in the order of ``Measurement.z``."""

    @property
    @abstractmethod
    def declarations(self) -> dict[str, Parameter]:
        """Every parameter, by name."""

    def published(self, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
        """The declared values by name, in the units that their declarations name."""
        return published_values(self.declarations, dtype)


class Recipe(Declared):
    """A recursive estimator: constants from values, a first belief, and a pure step.

    :func:`difffilter.run`, the tracker, tuning and the engine work on any recipe.
    """

    if TYPE_CHECKING:  # fields of most recipes, properties of others

        @property
        def motion(self) -> Motion:
            """The motion model: what starts and golden walks are made of."""

        @property
        def sensors(self) -> tuple[Sensor, ...]:
            """The measurement models: what starts and names are made of."""

        @property
        def overrides(self) -> Mapping[str, Parameter]:
            """Declarations that replace the components' own, by name."""

        @property
        def iterations(self) -> int:
            """How often a step conditions beyond once."""

    @property
    def foretold(self) -> tuple[str, ...]:
        """Inputs that only a simulation knows; none of a filter that can be deployed."""
        return ()

    @property
    def mode_names(self) -> tuple[str, ...]:
        """Of a mixture; none for all else."""
        return ()

    @property
    def centralised(self) -> Recipe:
        """The same without local filters: the same estimates while nothing is isolated."""
        return self

    @abstractmethod
    def with_values(self, values: Values) -> Self:
        """The same recipe with other declared values; InputError if one does not fit."""

    @abstractmethod
    def prepare(self, values: Values | None = None, temperature: float | None = None) -> Constants:
        """Constants of a run from physical values (the declared ones where missing).

        Args:
            values: by parameter name, differentiable.
            temperature: of the soft weights and gates, for training; None for the hard,
                published forms.

        Raises:
            InputError: an unknown name, a wrong shape or an inadmissible value.
        """

    @abstractmethod
    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        """Raise InputError if a known input is missing: a platform, or what is foretold."""

    @abstractmethod
    def start(self, mean: Tensor, deviations: Tensor) -> Belief:
        """Initial belief from a mean (..., n) and deviations (..., n, n), memory at its start."""

    @abstractmethod
    def step(
        self, constants: Constants, belief: Belief, measurement: Measurement
    ) -> tuple[Belief, Record]:
        """One row: the belief after it, and the record of what was done.

        Pure and of static shape, like :func:`difffilter.step`, which says more.
        """


@dataclass(frozen=True)
class Modelled(Recipe):
    """A recipe of one motion and its sensors; base of :class:`Filter` and :class:`Fusion`.

    Attributes:
        motion, sensors: the models; channels are those of the sensors, in order.
        linearise: ``taylor`` (first order, EKF) or ``cubature`` (SRCKF, see
            :mod:`difffilter.core.cubature`), of motion and sensors.
        start_sigma: initial standard deviation of each state (parameter ``start.sigma``),
            used where a run's start has no covariance; None for no such parameter. A state
            given as 0 is known exactly: it stays 0 in tuning too.
        overrides: declarations that replace the components' own (published value, source,
            tuned or not), by name.

    Raises:
        InputError: an unknown rule, a channel name twice, an override of no parameter.
    """

    motion: Motion
    sensors: tuple[Sensor, ...]
    linearise: str = field(default="taylor", kw_only=True)
    start_sigma: Number | None = field(default=None, kw_only=True)
    overrides: Mapping[str, Parameter] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        if self.linearise not in RULES:
            raise InputError(f"linearise: found {self.linearise!r}, expected {' or '.join(RULES)}")
        names = self.channels
        if len(set(names)) != len(names):
            raise InputError(f"channels: found a name twice in {', '.join(names)}")
        unknown = set(self.overrides) - set(self._own)
        if unknown:
            raise InputError(
                f"{min(unknown)}: no such parameter, expected one of {', '.join(self._own)}"
            )

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the n states, the position first."""
        return self.motion.states

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the m channels, in the order of ``Measurement.z``."""
        return tuple(name for sensor in self.sensors for name in sensor.channels)

    @property
    def _more_parameters(self) -> tuple[Parameter, ...]:
        """Those that are neither the motion's, nor the sensors', nor the start's."""
        return ()

    def _more_constants(self, values: Values) -> dict[str, Tensor]:
        """Constants that neither motion nor sensors make of the complete values."""
        return {}

    @cached_property
    def _own(self) -> dict[str, Parameter]:
        parts: tuple[Motion | Sensor, ...] = (self.motion, *self.sensors)
        own = [p for part in parts for p in part.parameters]
        own += self._more_parameters
        if self.start_sigma is not None:
            own.append(declared_start(self.start_sigma, self.states))
        return declare(own)

    @cached_property
    def declarations(self) -> dict[str, Parameter]:
        """Every parameter of the filter, by name."""
        return declare((self._own | dict(self.overrides)).values())

    def with_values(self, values: Values) -> Self:
        """The same recipe with other declared values; InputError if one does not fit."""
        changed = {
            name: replace(self.declarations[name], value=as_number(value))
            for name, value in check_values(self.declarations, values).items()
        }
        return replace(self, overrides=dict(self.overrides) | changed)

    def prepare(self, values: Values | None = None, temperature: float | None = None) -> Constants:
        """Constants of a run from physical values (the declared ones where missing).

        Args:
            values: by parameter name, differentiable.
            temperature: of the soft weights and gates, for training; None for the hard,
                published forms.

        Raises:
            InputError: an unknown name, a wrong shape or an inadmissible value.
        """
        given = check_values(self.declarations, values)
        dtype = next(iter(given.values())).dtype if given else torch.float64
        complete = self.published(dtype) | given
        constants = dict(complete)
        parts: tuple[Motion | Sensor, ...] = (self.motion, *self.sensors)
        for part in parts:
            constants.update(part.prepare(complete).items())
        constants.update(self._more_constants(complete))
        if temperature is not None:
            constants["temperature"] = torch.tensor(temperature, dtype=dtype)
        return Constants(constants)

    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        """Raise InputError if a known input of a sensor is missing: a platform."""
        for sensor in self.sensors:
            if isinstance(sensor, StationSensor):
                sensor.check_inputs(inputs)


def check_independent(sensors: tuple[Sensor, ...], who: str) -> None:
    """InputError unless every sensor's noise is independent between channels."""
    for sensor in sensors:
        if common_noise(sensor):
            raise InputError(
                f"{who}: found noise common to channels of {sensor.channels[0]}, "
                "expected independent noise"
            )


def declared_start(start_sigma: Number, states: tuple[str, ...]) -> Parameter:
    """Declaration of ``start.sigma``."""
    sigma = as_number(start_sigma)
    shape = torch.tensor(sigma).shape
    if shape not in ((), (len(states),)):
        raise InputError(
            f"start.sigma: found shape {list(shape)}, expected one number or {len(states)} numbers"
        )
    known = sigma if isinstance(sigma, tuple) else ()
    return Parameter(
        "start.sigma",
        sigma,
        Positive(tuple(i for i, entry in enumerate(known) if entry == 0.0)),
        "m, m/s",
        labels=states if isinstance(sigma, tuple) else (),
        meaning="initial standard deviation",
    )
