"""The weights as published: barron's family with its limits, and the efficiencies named."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from helpers import array, assert_close, number, tensor
from hypothesis import given
from hypothesis import strategies as st
from oracles import weights as published
from weight_cases import TEMPERATURES, VARIED, Numbers, evaluate

from difffilter.errors import InputError
from difffilter.weights.registry import WEIGHTS, barron

#: Huber's, and those whose source says so.
EFFICIENT = ["huber", *(n for n in VARIED if "95 %" in WEIGHTS[n].parameters[-1].source)]
S = torch.linspace(-12, 12, 97).double()


def at(s: torch.Tensor, alpha: float, k: float, temperature: float | None = None) -> torch.Tensor:
    return evaluate("barron", s, temperature, (alpha, k))


@given(k=st.floats(0.3, 6.0), temperature=st.sampled_from(TEMPERATURES))
def test_barron_s_weight_at_alpha_0_is_cauchy_s(k: float, temperature: float | None) -> None:
    cauchy = evaluate("cauchy", S, temperature, (math.sqrt(2.0) * k,))
    assert_close(at(S, 0.0, k, temperature), cauchy, 1e-13)


@pytest.mark.parametrize(("alpha", "tolerance"), [(-math.inf, 1e-14), (-1e12, 1e-10)])
def test_barron_s_weight_falls_to_welsch_s_as_alpha_does(alpha: float, tolerance: float) -> None:
    assert_close(at(S, alpha, 2.0), evaluate("welsch", S, None, (2.0,)), tolerance)


@pytest.mark.parametrize(("alpha", "tolerance"), [(2.0, 0.0), (2.0 - 1e-12, 1e-10)])
def test_barron_s_weight_rises_to_one_as_alpha_does_to_2(alpha: float, tolerance: float) -> None:
    assert_close(at(S, alpha, 2.0), torch.ones_like(S), tolerance)


@pytest.mark.parametrize("alpha", [2.0, 0.0, -math.inf])
def test_barron_s_weight_at_a_limit_is_the_published_one(alpha: float) -> None:
    assert_close(at(S, alpha, 1.3), published.barron(array(S), alpha, 1.3), 1e-14)


@given(low=st.floats(-100.0, 1.999), high=st.floats(-100.0, 1.999), s=st.floats(0.0, 1e3))
def test_the_lower_alpha_the_more_is_rejected(low: float, high: float, s: float) -> None:
    low, high = sorted((low, high))
    less, more = (float(at(tensor([s]), alpha, 1.5)) for alpha in (low, high))
    assert less <= more * (1 + 1e-12)


@pytest.mark.parametrize("alpha", [2.0 - 1e-12, 2.0 - 1e-6, -1e6, -1e12])
def test_the_gradient_very_near_a_limit_is_the_exact_one(alpha: float) -> None:
    """Of -log w = b/2 log1p(x/b): towards b (log1p(x/b) - x/(b+x))/2, towards x b/(b+x)/2."""
    s = tensor([0.0, 0.3, 2.0, 40.0])
    values = {"barron.alpha": tensor(alpha), "barron.k": tensor(1.5)}
    leaves = [x.requires_grad_() for x in (s, *values.values())]
    w = barron(s, barron.prepare(values), None)
    found = torch.autograd.grad(w.sum(), leaves)
    w0, s0, x, b = array(w), array(s), (array(s) / 1.5) ** 2, 2.0 - alpha
    small = x / b < 1e-3  # where the difference below would cancel
    towards_b = np.where(small, 0.25 * (x / b) ** 2, 0.5 * (np.log1p(x / b) - x / (b + x)))
    towards_x = -0.5 * w0 * b / (b + x)
    assert_close(found[0], towards_x * 2 * s0 / 1.5**2, 1e-9)
    assert float(found[1]) == pytest.approx(float((w0 * towards_b).sum()), rel=1e-3, abs=1e-13)
    assert float(found[2]) == pytest.approx(float((-2 * x / 1.5 * towards_x).sum()), rel=1e-9)


@pytest.mark.parametrize("alpha", [2.0, -math.inf])
def test_the_gradient_at_a_limit_is_finite(alpha: float) -> None:
    leaves = [tensor([0.0, 1.0, 1e6]), tensor(alpha), tensor(1.5)]
    s, a, k = (x.requires_grad_() for x in leaves)
    w = barron(s, barron.prepare({"barron.alpha": a, "barron.k": k}), None)
    for gradient in torch.autograd.grad(w.sum(), (s, a, k)):
        assert bool(torch.isfinite(gradient).all())


def test_barron_s_alpha_stays_below_2() -> None:
    alpha, _ = barron.parameters
    with pytest.raises(InputError, match=r"barron\.alpha.*below 2"):
        alpha.check(tensor(2.0))
    assert number(alpha.constraint.physical(tensor(5.0))) < 2.0


@pytest.mark.parametrize("numbers", [(4.0,), (1.0,), (30.0,)])
def test_student_t_s_weight_is_clipped_at_one_sigma(numbers: Numbers) -> None:
    w = evaluate("student-t", tensor([0.0, 0.5, 1.0, 1.001]), None, numbers)
    assert w[:3].tolist() == [1.0, 1.0, 1.0]
    assert float(w[3]) < 1.0


@pytest.mark.parametrize("name", EFFICIENT)
def test_a_default_said_to_keep_95_percent_efficiency_on_normal_noise_does(name: str) -> None:
    """Of psi = s w(s): E[psi']^2 / E[psi^2], with E[psi'] = E[s psi] on normal noise."""
    s = np.linspace(-12, 12, 24_001)
    density = np.exp(-0.5 * s**2) / math.sqrt(2 * math.pi) * (s[1] - s[0])
    w = array(evaluate(name, tensor(s)))
    efficiency = (density @ (s**2 * w)) ** 2 / (density @ (s**2 * w**2))
    assert efficiency == pytest.approx(0.95, abs=5e-4)
