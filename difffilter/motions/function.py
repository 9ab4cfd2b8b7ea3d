"""A user's motion model: torch functions, differentiated automatically."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from difffilter.core.jacobian import jacobian_times
from difffilter.errors import InputError
from difffilter.motions.protocol import KINDS, Inputs, kinds_by_name
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants

__all__ = ["FunctionMotion"]

NoiseFunction = Callable[[Tensor, Tensor, Inputs, Constants], Tensor]


@dataclass(frozen=True)
class FunctionMotion:
    """A user's motion model: torch functions for the transition and the process noise.

    Attributes:
        states: names of the n states.
        function: (state (..., n), dt, inputs, values) -> (..., n); any leading dimensions.
        noise_function: (state, dt, inputs, values) -> deviations (..., n, q) of the process
            noise, at the state before the step; or (dt, values) -> (..., n, q).
        parameters: declarations of the values that the two functions read.
        linear: whether the function is linear in the state.
        kinds: which states (and numbers of ``tangent``) are a ``position``, ``velocity``,
            ``angle`` or ``other``; by default what x, y, z, vx, vy, vz say by their names.
        tangent: names of the p numbers of a shift; the states by default. The noise is in
            this space too.
        retract_function, local_function: (state (..., n), shift (..., p)) -> the state moved
            by it, and (a, b) -> the shift from a to b, where plus and minus do not serve:
            angles that wrap, unit quaternions. Both or neither.

    Raises:
        InputError: an unknown kind or state in ``kinds``; one of retract and local alone; a
            noise function of other than four or two arguments.
    """

    states: tuple[str, ...]
    function: Callable[[Tensor, Tensor, Inputs, Constants], Tensor]
    noise_function: Callable[..., Tensor]
    parameters: tuple[Parameter, ...] = field(default=())
    linear: bool = False
    kinds: Mapping[str, str] = field(default_factory=dict)
    tangent: tuple[str, ...] = ()
    retract_function: Callable[[Tensor, Tensor], Tensor] | None = None
    local_function: Callable[[Tensor, Tensor], Tensor] | None = None

    def __post_init__(self) -> None:
        for name, kind in self.kinds.items():
            if name not in (*self.states, *self.tangent) or kind not in KINDS:
                raise InputError(
                    f"motion kinds: found {name} = {kind!r}, expected a state "
                    f"({', '.join(self.states)}) and one of {', '.join(KINDS)}"
                )
        if (self.retract_function is None) is not (self.local_function is None):
            raise InputError("motion: found one of retract and local, expected both or neither")
        if self.flat and self.tangent not in ((), self.states):
            raise InputError("motion tangent: expected retract and local with it")
        object.__setattr__(self, "kinds", kinds_by_name(self.states) | dict(self.kinds))
        object.__setattr__(self, "tangent", self.tangent or self.states)
        object.__setattr__(self, "_noise", noise_of(self.noise_function))

    @property
    def flat(self) -> bool:
        return self.retract_function is None

    def prepare(self, values: Values) -> Constants:
        return Constants({p.name: values[p.name] for p in self.parameters})

    def transition(self, mean: Tensor, dt: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        return self.function(mean, dt, inputs, constants)

    def propagate(
        self, mean: Tensor, deviations: Tensor, dt: Tensor, inputs: Inputs, constants: Constants
    ) -> Tensor:
        def moved(state: Tensor) -> Tensor:
            return self.function(state, dt, inputs, constants)

        if self.flat:
            return jacobian_times(moved, mean, deviations)
        centre = moved(mean)
        zero = torch.zeros_like(deviations[..., 0])
        return jacobian_times(
            lambda shift: self.local(centre, moved(self.retract(mean, shift))), zero, deviations
        )

    def noise(self, mean: Tensor, dt: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        noise: NoiseFunction = self._noise  # type: ignore[attr-defined]
        return noise(mean, dt, inputs, constants)

    def retract(self, mean: Tensor, shift: Tensor) -> Tensor:
        return mean + shift if self.retract_function is None else self.retract_function(mean, shift)

    def local(self, a: Tensor, b: Tensor) -> Tensor:
        return b - a if self.local_function is None else self.local_function(a, b)


def noise_of(function: Callable[..., Tensor]) -> NoiseFunction:
    """The noise function in its full form, (state, dt, inputs, values)."""
    signature = inspect.signature(function)
    for count in (4, 2):
        try:
            signature.bind(*range(count))
        except TypeError:
            continue
        if count == 4:
            return function
        return lambda mean, dt, inputs, values: function(dt, values)
    raise InputError(
        f"motion noise: found a function of {signature}, expected (state, dt, inputs, values) "
        "or (dt, values)"
    )
