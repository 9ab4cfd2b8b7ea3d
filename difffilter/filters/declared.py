"""What every estimator tells about itself: states, channels, and parameters declared once."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Protocol, Self

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.logs.states import kinds_by_name
from difffilter.parameters.parameters import (
    Parameter,
    Values,
    as_number,
    check_values,
    declare,
    published_values,
)
from difffilter.parameters.values import Constants
from difffilter.sensors.sensor import Sensor

__all__ = ["Composed", "Declared", "Overridable", "Part"]


class Declared(ABC):
    """What an estimator of any kind tells about itself: states, channels, parameters."""

    @property
    @abstractmethod
    def states(self) -> tuple[str, ...]:
        """Names of the n states, the position first."""

    @property
    def error_states(self) -> tuple[str, ...]:
        """Names of the rows of the deviations: the states, unless they are no plain numbers."""
        return self.states

    @property
    def kinds(self) -> Mapping[str, str]:
        """What each state is: ``position``, ``velocity``, ``angle`` or ``other``, by name."""
        return kinds_by_name(self.states)

    @property
    def bare_states(self) -> tuple[str, ...]:
        """The states without errors of sensors that last: what starts and truth tell."""
        return self.states

    @property
    def bare_sensors(self) -> tuple[Sensor, ...]:
        """The sensors, errors that last taken as noise of each row."""
        sensors: tuple[Sensor, ...] = getattr(self, "sensors", ())
        return sensors

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

    def complete(self, values: Values | None) -> dict[str, Tensor]:
        """Every value by name: those given, checked, and the declared ones for the others.

        Raises:
            InputError: an unknown name, a wrong shape or an inadmissible value.
        """
        given = check_values(self.declarations, values)
        dtype = next(iter(given.values())).dtype if given else torch.float64
        return self.published(dtype) | given

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


class Overridable(Declared):
    """Declarations of its own, which ``overrides`` replace; a frozen dataclass."""

    if TYPE_CHECKING:

        @property
        def overrides(self) -> Mapping[str, Parameter]:
            """Declarations that replace its own, by name."""

    @cached_property
    @abstractmethod
    def _own(self) -> dict[str, Parameter]:
        """Parameters as the components declare them."""

    @cached_property
    def declarations(self) -> dict[str, Parameter]:
        """Every parameter, by name."""
        unknown = set(self.overrides) - set(self._own)
        if unknown:
            raise InputError(
                f"{min(unknown)}: no such parameter, expected one of {', '.join(self._own)}"
            )
        return declare((self._own | dict(self.overrides)).values())

    def with_values(self, values: Values) -> Self:
        """The same with other declared values; InputError if one does not fit."""
        changed = {
            name: replace(self.declarations[name], value=as_number(value))
            for name, value in check_values(self.declarations, values).items()
        }
        return replace(self, overrides=dict(self.overrides) | changed)  # type: ignore[type-var]


class Part(Protocol):
    """A component that declares parameters: a motion, a sensor, a weight."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Declared parameters."""

    def prepare(self, values: Values) -> Any:
        """Constants by name, from the complete values."""


class Composed(Overridable):
    """Made of sensors and other parts: their channels, parameters and constants."""

    if TYPE_CHECKING:

        @property
        def sensors(self) -> tuple[Sensor, ...]:
            """The measurement models; channels are theirs, in order."""

    @property
    def parts(self) -> Sequence[Part]:
        """Components that declare parameters and prepare constants."""
        return self.sensors

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the m channels, in the order of ``Measurement.z``."""
        return tuple(name for sensor in self.sensors for name in sensor.channels)

    @property
    def _own_parameters(self) -> tuple[Parameter, ...]:
        return tuple(p for part in self.parts for p in part.parameters)

    @cached_property
    def _own(self) -> dict[str, Parameter]:
        return declare(self._own_parameters)

    def _more_constants(self, values: Values) -> dict[str, Tensor]:
        """Constants that no part makes of the complete values."""
        return {}

    def prepare(self, values: Values | None = None, temperature: float | None = None) -> Constants:
        """Constants that the parts make of the values, and the values themselves."""
        complete = self.complete(values)
        constants = dict(complete)
        for part in self.parts:
            constants.update(part.prepare(complete).items())
        constants.update(self._more_constants(complete))
        if temperature is not None:
            dtype = next(iter(complete.values())).dtype if complete else torch.float64
            constants["temperature"] = torch.tensor(temperature, dtype=dtype)
        return Constants(constants)
