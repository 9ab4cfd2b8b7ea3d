"""Evaluating weight functions in tests."""

from __future__ import annotations

from helpers import tensor
from torch import Tensor

from difffilter.weights import WEIGHTS, Weight

NAMES = ("plain", "huber", "igg3", "tanh", "imq")
TEMPERATURES = (None, 1.0, 0.1, 0.01)


def values_of(weight: Weight, numbers: tuple[float, ...] | None = None) -> dict[str, Tensor]:
    """The weight's parameters at the given numbers, or at their defaults."""
    if not weight.parameters:
        return {}
    (parameter,) = weight.parameters
    if numbers is None:
        return {parameter.name: parameter.tensor()}
    return {parameter.name: tensor(numbers).reshape(parameter.tensor().shape)}


def evaluate(
    name: str, s: Tensor, temperature: float | None = None, numbers: tuple[float, ...] | None = None
) -> Tensor:
    weight = WEIGHTS[name]
    constants = weight.prepare(values_of(weight, numbers))
    return weight(s, constants, None if temperature is None else tensor(temperature))


def clipping_points(numbers: tuple[float, ...] | None) -> Tensor:
    """s = 0, the clipping points on both sides, and far out."""
    points = list(numbers or ())
    return tensor([0.0, *points, *(-p for p in points), 1e6, -1e6])
