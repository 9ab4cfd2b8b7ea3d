"""Chi-square thresholds of any degree of freedom, from one of the first."""

from __future__ import annotations

import math

import pytest
import torch
from helpers import array, number, tensor
from hypothesis import given
from hypothesis import strategies as st
from oracles import chi_square
from torch import Tensor

from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.motions.blocks import ConstantVelocity
from difffilter.robust.chi_square import equivalent_thresholds, log_survival
from difffilter.robust.gate import Gate
from difffilter.sensors.builtin import Position

MOST = 9


def gate_threshold(significance: float) -> float:
    (parameter,) = Gate(significance=significance).parameters
    assert parameter.name == "gate.threshold"
    return number(parameter.tensor())


@pytest.mark.parametrize("degrees", [1, 2, 3, 4, 7, 12])
@given(x=st.floats(1e-6, 300.0))
def test_the_survival_function_is_the_integral_of_the_density(degrees: int, x: float) -> None:
    expected = chi_square.survival(x, degrees)
    assert number(log_survival(tensor(x), degrees).exp()) == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("degrees", [1, 2, 3, 8])
def test_the_survival_function_is_finite_far_into_the_tail(degrees: int) -> None:
    x = tensor(1e6).requires_grad_()
    value = log_survival(x, degrees)
    (slope,) = torch.autograd.grad(value, x)
    assert number(value) == pytest.approx(-5e5, rel=1e-4)
    assert number(slope) == pytest.approx(-0.5, rel=1e-4)


@pytest.mark.parametrize("significance", [0.5, 0.05, 0.01, 0.005, 1e-6])
def test_the_thresholds_are_the_chi_square_quantiles_at_one_significance(
    significance: float,
) -> None:
    gate = Gate(significance=significance)
    thresholds = gate.prepare({"gate.threshold": tensor(gate_threshold(significance))}, MOST)
    expected = [chi_square.quantile(significance, d) for d in range(1, MOST + 1)]
    assert array(thresholds["gate.thresholds"]) == pytest.approx(expected, rel=1e-8)


@given(threshold=st.floats(1e-4, 1e4))
def test_thresholds_rise_with_the_degrees_and_share_one_significance(threshold: float) -> None:
    thresholds = equivalent_thresholds(tensor(threshold), MOST)
    assert bool((thresholds.diff() > 0).all())
    wanted = number(log_survival(tensor(threshold), 1))
    for degrees, x in enumerate(thresholds, start=1):
        assert number(log_survival(x, degrees)) == pytest.approx(wanted, rel=1e-9, abs=1e-14)


@pytest.mark.parametrize("threshold", [0.01, 0.7, 7.879, 60.0, 1e4])
def test_float32_finds_the_thresholds_of_float64(threshold: float) -> None:
    single = equivalent_thresholds(torch.tensor(threshold), MOST)
    assert single.dtype == torch.float32
    double = array(equivalent_thresholds(tensor(threshold), MOST))
    assert array(single) == pytest.approx(double, rel=1e-4)


@pytest.mark.parametrize("threshold", [0.3, 7.879, 40.0])
def test_gradcheck_of_every_threshold_towards_the_first(threshold: float) -> None:
    def function(threshold: Tensor) -> Tensor:
        return equivalent_thresholds(threshold, MOST)

    assert torch.autograd.gradcheck(function, tensor(threshold).requires_grad_())


@pytest.mark.parametrize(
    ("significance", "expected"), [(0.005, 7.879), (0.01, 6.635), (0.05, 3.841)]
)
def test_the_threshold_is_the_tabled_one_of_one_degree(
    significance: float, expected: float
) -> None:
    assert gate_threshold(significance) == pytest.approx(expected, abs=5e-4)


def test_the_default_significance_is_paper_1_s() -> None:
    (default,), (other,) = Gate().parameters, Gate(significance=0.01).parameters
    assert number(default.tensor()) == gate_threshold(0.005)
    assert default.source.startswith("paper 1")
    assert "paper" not in other.source


@pytest.mark.parametrize("significance", [1e-10, 1e-13, 1e-17, 1e-100])
def test_a_very_small_significance_has_its_exact_threshold(significance: float) -> None:
    """log P(e > x) = log significance, to more than the digits that 1 - significance keeps."""
    threshold = tensor(gate_threshold(significance))
    assert number(log_survival(threshold, 1)) == pytest.approx(math.log(significance), abs=1e-6)


@pytest.mark.parametrize("significance", [0.0, 1.0, -0.1, 2.0, math.nan])
def test_a_significance_outside_0_to_1_is_an_error(significance: float) -> None:
    with pytest.raises(InputError, match=r"significance: found .*between 0 and 1"):
        Gate(significance=significance)


@pytest.mark.parametrize(("scope", "most"), [("channel", 1), ("sensor", 2), ("all", 5)])
def test_a_filter_prepares_thresholds_up_to_its_largest_group(scope: str, most: int) -> None:
    sensors = (Position(name="p"), Position(name="q"), Position(name="r", axes=1))
    filter = Filter(ConstantVelocity(2), sensors, scope=scope, gate=Gate())
    expected = [chi_square.quantile(0.005, d) for d in range(1, most + 1)]
    assert array(filter.prepare()["gate.thresholds"]) == pytest.approx(expected, rel=1e-8)
