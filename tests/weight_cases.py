"""Evaluating weight functions in tests."""

from __future__ import annotations

from helpers import tensor
from torch import Tensor

from difffilter.weights.registry import WEIGHTS, Weight

NAMES = tuple(WEIGHTS)
#: All but the one without parameters.
VARIED = tuple(name for name in NAMES if name != "plain")
TEMPERATURES = (None, 1.0, 0.1, 0.01)
#: Values that the literature uses, besides the defaults; for barron [alpha, k].
LITERATURE: dict[str, list[tuple[float, ...]]] = {
    "huber": [(1.0,), (1.345,), (2.0,)],
    "igg3": [(1.2, 4.0), (1.0, 2.5), (1.5, 2.5), (1.0, 8.0), (1.5, 8.0)],
    "tanh": [(1.5, 4.0), (1.0, 4.0), (1.5, 3.0), (2.0, 6.0)],
    "danish": [(1.5,), (2.0,), (3.0,)],
    "tukey": [(3.0,), (4.685,), (6.0,)],
    "cauchy": [(1.0,), (2.385,)],
    "welsch": [(2.0,), (2.985,)],
    "imq": [(1.0,), (3.0,), (5.0,)],
    "student-t": [(1.0,), (4.0,), (10.0,)],
    "barron": [(0.0, 1.686), (1.0, 1.0), (-2.0, 2.0), (1.9, 1.5), (-50.0, 3.0)],
}

Numbers = tuple[float, ...]


def values_of(weight: Weight, numbers: Numbers | None = None) -> dict[str, Tensor]:
    """The weight's parameters at the given numbers, in order, or at their defaults."""
    values, at = {}, 0
    for parameter in weight.parameters:
        value = parameter.tensor()
        if numbers is not None:
            here = numbers[at : at + value.numel()]
            value = tensor(here).reshape(value.shape)
            at += len(here)
        values[parameter.name] = value
    return values


def evaluate(
    name: str, s: Tensor, temperature: float | None = None, numbers: Numbers | None = None
) -> Tensor:
    weight = WEIGHTS[name]
    constants = weight.prepare(values_of(weight, numbers))
    return weight(s, constants, None if temperature is None else tensor(temperature))


def kinks(name: str, numbers: Numbers | None) -> Numbers:
    """Residuals at which the hard form may have a kink, or which scale it."""
    if name == "student-t":
        return (1.0,)
    return tuple(numbers or ())[1:] if name == "barron" else tuple(numbers or ())


def clipping_points(name: str, numbers: Numbers | None) -> Tensor:
    """s = 0, the clipping points on both sides, and far out."""
    points = kinks(name, numbers)
    return tensor([0.0, *points, *(-p for p in points), 1e6, -1e6])
