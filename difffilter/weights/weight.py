"""What a weight function is, and the smooth parts that soft forms are made of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from difffilter.parameters.constraints import OrderedPair, Positive
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants

__all__ = ["Weight", "clipping_pair", "clipping_point", "soft_abs", "soft_excess", "soft_relu"]

WeightFunction = Callable[[Tensor, Constants, Tensor | None], Tensor]


@dataclass(frozen=True)
class Weight:
    """A weight function with the parameters that it declares.

    Attributes:
        name: as in scenario files and checkpoints.
        function: (s, constants, temperature or None) -> w, elementwise on s (..., m).
        parameters: declarations; their values arrive in ``constants`` by name.
        derive: further constants computed once per run from the values.

    s is in sigmas. A hard form has ``temperature`` None; a soft one is smooth in s and in its
    parameters and exactly 1 at s = 0.
    """

    name: str
    function: WeightFunction
    parameters: tuple[Parameter, ...] = ()
    derive: Callable[[Values], dict[str, Tensor]] | None = None

    def __call__(
        self, s: Tensor, constants: Constants, temperature: Tensor | None = None
    ) -> Tensor:
        """w(s) in [0, 1]; ``constants`` from :meth:`prepare`."""
        return self.function(s, constants, temperature)

    def prepare(self, values: Values) -> Constants:
        """Values and derived constants that the function reads."""
        constants = Constants({p.name: values[p.name] for p in self.parameters})
        return constants | (self.derive(values) if self.derive else {})


def soft_relu(x: Tensor, temperature: Tensor) -> Tensor:
    """temperature * log(1 + exp(x / temperature)): max(x, 0) as the temperature -> 0."""
    return temperature * softplus(x / temperature, threshold=40.0)


def soft_excess(x: Tensor, bound: Tensor | float, temperature: Tensor | None) -> Tensor:
    """max(x - bound, 0) for x >= 0 and a bound above 0; soft: smooth, and exactly 0 at x = 0."""
    if temperature is None:
        return (x - bound).clamp_min(0.0)
    below = torch.as_tensor(-bound, dtype=x.dtype, device=x.device)
    return soft_relu(x - bound, temperature) - soft_relu(below, temperature)


def soft_abs(s: Tensor) -> Tensor:
    """Smooth |s|: even, 0 at 0, below |s| by at most a half."""
    return (s.square() + 0.25).sqrt() - 0.5


def clipping_point(name: str, value: float, source: str) -> Parameter:
    """Declaration of one clipping point k > 0, in sigmas."""
    return Parameter(name, value, Positive(), "sigma", source, meaning="clipping point")


def clipping_pair(
    name: str, value: tuple[float, float], labels: tuple[str, str], source: str
) -> Parameter:
    """Declaration of two ordered clipping points, in sigmas."""
    meaning = f"clipping points {labels[0]} < {labels[1]}"
    return Parameter(name, value, OrderedPair(), "sigma", source, labels=labels, meaning=meaning)
