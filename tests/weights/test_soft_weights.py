"""Soft forms of the weights: gradients, and convergence to the hard forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import array, tensor
from torch import Tensor
from weight_cases import (
    LITERATURE,
    TEMPERATURES,
    VARIED,
    Numbers,
    clipping_points,
    evaluate,
    kinks,
    values_of,
)

from difffilter.weights.registry import WEIGHTS

CASES = [(name, numbers) for name in VARIED for numbers in LITERATURE[name]]
#: Weights with a kink, which only the soft form smooths.
CLIPPED = ("huber", "igg3", "tanh", "danish", "tukey", "student-t")
#: One case of each weight, and several shapes of barron's.
CHECKED = [(n, p) for n, p in CASES if n == "barron" or p == LITERATURE[n][-1]]


def away_from_kinks(name: str, numbers: Numbers) -> Tensor:
    grid = torch.linspace(-8.13, 8.17, 60).double()
    near = (grid.abs().unsqueeze(-1) - tensor(kinks(name, numbers))).abs().amin(-1) < 0.05
    return grid[~near]


def test_every_weight_with_parameters_has_cases_here() -> None:
    assert set(LITERATURE) == set(VARIED)
    assert {name for name, _ in CHECKED} == set(VARIED)


@pytest.mark.parametrize("temperature", TEMPERATURES)
@pytest.mark.parametrize(("name", "numbers"), CHECKED)
def test_gradcheck_passes_over_the_residual_and_every_parameter(
    name: str, numbers: Numbers, temperature: float | None
) -> None:
    weight = WEIGHTS[name]
    values = values_of(weight, numbers)
    s = away_from_kinks(name, numbers)
    if temperature is not None and temperature >= 0.1:
        s = torch.cat([s, clipping_points(name, numbers)[:-2]])

    def function(s: Tensor, *given: Tensor) -> Tensor:
        soft = None if temperature is None else tensor(temperature)
        return weight(s, weight.prepare(dict(zip(values, given, strict=True))), soft)

    inputs = [x.requires_grad_() for x in (s, *values.values())]
    assert torch.autograd.gradcheck(function, inputs, atol=1e-6, rtol=1e-4)


@pytest.mark.parametrize(("name", "numbers"), CASES)
def test_the_soft_form_at_temperature_0_01_is_the_hard_one(name: str, numbers: Numbers) -> None:
    s = torch.linspace(0, 15, 30_001).double()
    apart = (evaluate(name, s, 0.01, numbers) - evaluate(name, s, None, numbers)).abs()
    assert float(apart.max()) <= 0.02


@pytest.mark.parametrize("name", CLIPPED)
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
    [
        ("huber", 0.5),
        ("huber", 1.2),
        ("igg3", 0.7),
        ("igg3", 5.0),
        ("tanh", 0.7),
        ("tanh", 5.0),
        ("danish", 0.5),
        ("danish", 1.9),
        ("tukey", 4.7),
        ("tukey", 6.0),
        ("student-t", 0.5),
        ("student-t", 0.9),
    ],
)
def test_the_soft_form_feels_a_clipping_point_that_the_hard_form_does_not(
    name: str, s: float
) -> None:
    assert not parameter_slope(name, s, None).any()
    slope = parameter_slope(name, s, 1.0)
    assert (np.abs(slope) > 1e-6).all()


@pytest.mark.parametrize("name", [n for n in WEIGHTS if n not in CLIPPED])
def test_a_weight_without_a_kink_is_smooth_already(name: str) -> None:
    s = torch.linspace(-9, 9, 50).double()
    assert torch.equal(evaluate(name, s, 1.0), evaluate(name, s))
