"""Soft forms of the weights: gradients, and convergence to the hard forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import array, tensor
from torch import Tensor
from weight_cases import NAMES, TEMPERATURES, clipping_points, evaluate, values_of

from difffilter.weights import WEIGHTS

#: Values that the literature uses, besides the defaults.
LITERATURE: dict[str, list[tuple[float, ...]]] = {
    "huber": [(1.0,), (1.345,), (2.0,)],
    "igg3": [(1.2, 4.0), (1.0, 2.5), (1.5, 2.5), (1.0, 8.0), (1.5, 8.0)],
    "tanh": [(1.5, 4.0), (1.0, 4.0), (1.5, 3.0), (2.0, 6.0)],
    "imq": [(1.0,), (3.0,), (5.0,)],
}


def away_from_kinks(name: str, numbers: tuple[float, ...]) -> Tensor:
    grid = torch.linspace(-8.13, 8.17, 60).double()
    near = (grid.abs().unsqueeze(-1) - tensor(numbers)).abs().amin(-1) < 0.05
    return grid[~near]


@pytest.mark.parametrize("temperature", TEMPERATURES)
@pytest.mark.parametrize("name", [n for n in NAMES if n != "plain"])
def test_gradcheck_passes_over_the_residual_and_every_parameter(
    name: str, temperature: float | None
) -> None:
    weight = WEIGHTS[name]
    (key, value) = next(iter(values_of(weight).items()))
    numbers = tuple(value.reshape(-1).tolist())
    s = away_from_kinks(name, numbers)
    if temperature is not None and temperature >= 0.1:
        s = torch.cat([s, clipping_points(numbers)[:-2]])

    def function(s: Tensor, value: Tensor) -> Tensor:
        soft = None if temperature is None else tensor(temperature)
        return weight(s, weight.prepare({key: value}), soft)

    inputs = (s.requires_grad_(), value.requires_grad_())
    assert torch.autograd.gradcheck(function, inputs, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize(("name", "numbers"), [(n, p) for n in LITERATURE for p in LITERATURE[n]])
def test_the_soft_form_at_temperature_0_01_is_the_hard_one(
    name: str, numbers: tuple[float, ...]
) -> None:
    s = torch.linspace(0, 15, 30_001).double()
    apart = (evaluate(name, s, 0.01, numbers) - evaluate(name, s, None, numbers)).abs()
    assert float(apart.max()) <= 0.02


@pytest.mark.parametrize("name", ["huber", "igg3", "tanh"])
def test_the_soft_form_converges_to_the_hard_one(name: str) -> None:
    s = torch.linspace(-12, 12, 4_001).double()
    hard = evaluate(name, s)
    apart = [float((evaluate(name, s, t) - hard).abs().max()) for t in (0.1, 0.01, 1e-3, 1e-4)]
    assert apart[-1] < 2e-4
    assert apart == sorted(apart, reverse=True)


def parameter_slope(name: str, s: float, temperature: float | None) -> np.ndarray:
    """Gradient of w(s) towards the weight's own parameter."""
    weight = WEIGHTS[name]
    (key, value) = next(iter(values_of(weight).items()))
    value.requires_grad_()
    soft = None if temperature is None else tensor(temperature)
    w = weight(tensor([s]), weight.prepare({key: value}), soft)
    return array(torch.autograd.grad(w.sum(), value)[0])


@pytest.mark.parametrize(
    ("name", "s"),
    [("huber", 0.5), ("huber", 1.2), ("igg3", 0.7), ("igg3", 5.0), ("tanh", 0.7), ("tanh", 5.0)],
)
def test_the_soft_form_feels_a_clipping_point_that_the_hard_form_does_not(
    name: str, s: float
) -> None:
    assert not parameter_slope(name, s, None).any()
    slope = parameter_slope(name, s, 1.0)
    assert (np.abs(slope) > 1e-6).all()


def test_the_imq_weight_is_smooth_already() -> None:
    s = torch.linspace(-9, 9, 50).double()
    assert torch.equal(evaluate("imq", s, 1.0), evaluate("imq", s))
