"""Parameters: declared once, physical to everybody, unconstrained to the optimiser."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NoReturn

import torch
from torch import Tensor, nn

from difffilter.errors import InputError
from difffilter.parameters.constraints import Constraint, Real
from difffilter.parameters.values import Constants, Values

__all__ = ["Constants", "Parameter", "ParameterSet", "Values", "declare", "published_values"]

Number = float | tuple[float, ...] | tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class Parameter:
    """The one declaration of a parameter.

    Attributes:
        name: dotted name, for example ``motion.acceleration``.
        value: published value: a number, a vector, or a matrix, as nested tuples.
        constraint: admissible set and the map to unconstrained numbers.
        unit: physical unit of ``value``; "1" for pure numbers.
        source: where the published value comes from.
        tuned: whether tuning may change it.
        prior: standard deviation, in unconstrained numbers, of a normal prior centred on
            the published value (for a positive parameter 0.1 is about 10 %); None for none.
        labels: name of each entry of a vector, for tables and plots.
        meaning: one line for the reader.
        given: unit that the published value was given in, and its factor to ``unit``: tables
            for people show that; None for ``unit`` itself.
        noise: whether it scales Q or R: what a likelihood or a sample covariance can estimate.
    """

    name: str
    value: Number
    constraint: Constraint = field(default_factory=Real)
    unit: str = "1"
    source: str = ""
    tuned: bool = False
    prior: float | None = None
    labels: tuple[str, ...] = ()
    meaning: str = ""
    noise: bool = False
    given: tuple[str, float] | None = field(default=None, compare=False)

    @property
    def shown(self) -> tuple[str, float]:
        """Unit for tables, and its factor to ``unit``."""
        return self.given or (self.unit, 1.0)

    def tensor(self, dtype: torch.dtype = torch.float64) -> Tensor:
        """Published value as a tensor."""
        return torch.tensor(self.value, dtype=dtype)

    def check(self, value: Tensor) -> None:
        """Raise InputError unless ``value`` has the declared shape and is admissible."""
        if value.shape != self.tensor().shape:
            raise InputError(
                f"{self.name}: found shape {list(value.shape)}, "
                f"expected {list(self.tensor().shape)}"
            )
        if not self.constraint.admits(value):
            raise InputError(
                f"{self.name}: found {value.tolist()}, expected {self.constraint.expected()}"
            )

    def entries(self) -> list[str]:
        """Name of each scalar entry, in row-major order."""
        shape = self.tensor().shape
        if not shape:
            return [self.name]
        if len(shape) == 1 and self.labels:
            return [f"{self.name}.{label}" for label in self.labels]
        return [
            f"{self.name}[{','.join(map(str, index))}]"
            for index in torch.cartesian_prod(*[torch.arange(s) for s in shape])
            .reshape(-1, len(shape))
            .tolist()
        ]


def as_number(value: Any) -> Number:
    """Nested lists or tensors to the nested tuples of :class:`Parameter`."""
    if isinstance(value, Tensor):
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return tuple(as_number(item) for item in value)  # type: ignore[return-value]
    return float(value)


def declare(parameters: Iterable[Parameter]) -> dict[str, Parameter]:
    """Collect declarations by name; the same name twice must be the same declaration."""
    table: dict[str, Parameter] = {}
    for parameter in parameters:
        known = table.setdefault(parameter.name, parameter)
        if known != parameter:
            raise InputError(f"{parameter.name}: declared twice with different contents")
        parameter.check(parameter.tensor())
    return table


def published_values(
    declarations: Mapping[str, Parameter], dtype: torch.dtype = torch.float64
) -> dict[str, Tensor]:
    """The published value of every declared parameter."""
    return {name: parameter.tensor(dtype) for name, parameter in declarations.items()}


class ParameterSet(nn.Module):
    """Where tuned parameters live: raw unconstrained tensors behind physical values.

    Args:
        declarations: by name, from :func:`declare` or ``filter.declarations``.
        values: physical start values; the published ones where a name is missing.
        dtype: float64 or float32.

    Raises:
        InputError: a name that is not declared, a wrong shape, a value outside its set.
    """

    def __init__(
        self,
        declarations: Mapping[str, Parameter],
        values: Values | None = None,
        dtype: torch.dtype = torch.float64,
    ) -> None:
        super().__init__()
        self.declarations = dict(declarations)
        self._fixed: dict[str, Tensor] = {}
        self._raw = nn.ParameterDict()
        start = {**published_values(declarations, dtype), **check_values(declarations, values)}
        for name, parameter in self.declarations.items():
            value = start[name].detach().to(dtype)
            if parameter.tuned:
                self._raw[_key(name)] = nn.Parameter(parameter.constraint.free(value))
            else:
                self._fixed[name] = value

    def values(self) -> dict[str, Tensor]:
        """Physical values, differentiable towards the tuned ones."""
        return {
            name: parameter.constraint.physical(self._raw[_key(name)])
            if parameter.tuned
            else self._fixed[name]
            for name, parameter in self.declarations.items()
        }

    def frozen_values(self) -> dict[str, Tensor]:
        """Physical values, detached copies."""
        return {name: value.detach().clone() for name, value in self.values().items()}

    def free(self) -> dict[str, nn.Parameter]:
        """The unconstrained tensors that an optimiser moves, by parameter name."""
        return {
            name: self._raw[_key(name)]
            for name, parameter in self.declarations.items()
            if parameter.tuned
        }

    def set_tuned(self, name: str, tuned: bool) -> NoReturn:
        """Now :meth:`with_tuned`: an InputError that says so, as the old name looked like a change.

        Raises:
            InputError: always.
        """
        raise InputError(
            "set_tuned: found the old name, expected parameters = parameters.with_"
            f"tuned({name!r}, {tuned}), which gives a copy"
        )

    def with_tuned(self, name: str, tuned: bool = True) -> ParameterSet:
        """A copy in which ``name`` is tuned or frozen; InputError if it is not declared."""
        if name not in self.declarations:
            raise InputError(
                f"{name}: no such parameter, expected one of {', '.join(self.declarations)}"
            )
        declarations = dict(self.declarations)
        declarations[name] = replace(declarations[name], tuned=tuned)
        dtype = self.values()[name].dtype
        return ParameterSet(declarations, self.frozen_values(), dtype)

    def negative_log_prior(self) -> Tensor:
        """Sum over tuned parameters with a prior of ((u - u_published) / sd)^2 / 2."""
        total = torch.zeros((), dtype=next(iter(self.values().values())).dtype)
        for name, raw in self.free().items():
            parameter = self.declarations[name]
            if parameter.prior is not None:
                centre = parameter.constraint.free(parameter.tensor(raw.dtype))
                total = total + 0.5 * ((raw - centre) / parameter.prior).square().sum()
        return total


def check_values(declarations: Mapping[str, Parameter], values: Values | None) -> dict[str, Tensor]:
    """``values`` after checking each against its declaration."""
    if isinstance(values, Constants):
        raise InputError("values: found the constants of a run, expected values by parameter name")
    checked = dict(values or {})
    for name, value in checked.items():
        if name not in declarations:
            raise InputError(
                f"{name}: no such parameter, expected one of {', '.join(declarations)}"
            )
        checked[name] = value = real(name, value)
        declarations[name].check(value)
    return checked


def real(name: str, value: Any) -> Tensor:
    """A tensor of real numbers: integers become float64; InputError for anything else."""
    if not isinstance(value, Tensor) or value.is_complex() or value.dtype == torch.bool:
        kind = value.dtype if isinstance(value, Tensor) else type(value).__name__
        raise InputError(f"{name}: found {kind}, expected a tensor of real numbers")
    return value if value.is_floating_point() else value.double()


def _key(name: str) -> str:
    return name.replace(".", "/")  # nn.ParameterDict forbids dots
