"""The chi-square gate: hard, soft, and the three actions."""

from __future__ import annotations

from statistics import NormalDist

import pytest
import torch
from helpers import assert_close, tensor
from torch import Tensor

from difffilter.errors import InputError
from difffilter.gate import ACTIONS, Gate

NIS = tensor([0.0, 3.0, 7.879, 7.880, 20.0, 1e6])
WEIGHT = tensor([1.0, 0.9, 0.8, 0.7, 0.5, 0.0])


def weigh(action: str, temperature: float | None = None) -> tuple[Tensor, Tensor]:
    gate = Gate(action)
    constants = {p.name: p.tensor() for p in gate.parameters}
    soft = None if temperature is None else tensor(temperature)
    return gate.weigh(WEIGHT, NIS, constants, soft)


def test_the_default_threshold_is_the_chi_square_quantile_at_significance_0_005() -> None:
    (parameter,) = Gate().parameters
    # One degree of freedom: the square of the normal quantile at 1 - 0.005 / 2.
    quantile = NormalDist().inv_cdf(1 - 0.0025) ** 2
    assert parameter.name == "gate.threshold"
    assert float(parameter.tensor()) == pytest.approx(quantile, rel=1e-9)


def test_the_hard_gate_passes_up_to_the_threshold_and_not_beyond() -> None:
    threshold = {"gate.threshold": tensor(4.0)}
    passed = Gate().passed(tensor([0.0, 4.0, 4.0 + 1e-12, 1e9]), threshold, None)
    assert torch.equal(passed, tensor([1.0, 1.0, 0.0, 0.0]))


def test_reject_leaves_weight_only_to_what_passes() -> None:
    weight, passed = weigh("reject")
    assert torch.equal(passed, tensor([1, 1, 1, 0, 0, 0]))
    assert torch.equal(weight, tensor([1.0, 0.9, 0.8, 0.0, 0.0, 0.0]))


def test_reweigh_uses_the_robust_weight_only_on_what_fails() -> None:
    weight, passed = weigh("reweigh")
    assert torch.equal(passed, tensor([1, 1, 1, 0, 0, 0]))
    assert torch.equal(weight, tensor([1.0, 1.0, 1.0, 0.7, 0.5, 0.0]))


def test_inflate_scales_the_weight_of_what_fails_by_threshold_over_nis() -> None:
    weight, passed = weigh("inflate")
    threshold = Gate().parameters[0].tensor()
    expected = WEIGHT * torch.where(threshold < NIS, threshold / NIS.clamp_min(1.0), 1.0)
    assert torch.equal(passed, tensor([1, 1, 1, 0, 0, 0]))
    assert_close(weight, expected, 1e-14)


@pytest.mark.parametrize("action", ACTIONS)
def test_the_soft_gate_becomes_the_hard_one_as_the_temperature_falls(action: str) -> None:
    hard, _ = weigh(action)
    soft, passed = weigh(action, 1e-6)
    assert_close(soft, hard, 1e-12)
    assert bool(((passed >= 0) & (passed <= 1)).all())


def test_the_soft_gate_is_one_half_at_the_threshold_and_falls_with_the_nis() -> None:
    threshold = {"gate.threshold": tensor(4.0)}
    passed = Gate().passed(tensor([1.0, 4.0, 6.0]), threshold, tensor(2.0))
    assert_close(passed, torch.sigmoid(tensor([1.5, 0.0, -1.0])), 1e-15)


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("temperature", [1.0, 0.1])
def test_gradcheck_passes_over_weight_nis_and_threshold(action: str, temperature: float) -> None:
    nis = tensor([0.0, 3.9, 4.3, 5.0]).requires_grad_()
    weight = tensor([1.0, 0.9, 0.6, 0.2]).requires_grad_()
    threshold = tensor(4.0).requires_grad_()

    def function(weight: Tensor, nis: Tensor, threshold: Tensor) -> tuple[Tensor, Tensor]:
        constants = {"gate.threshold": threshold}
        return Gate(action).weigh(weight, nis, constants, tensor(temperature))

    assert torch.autograd.gradcheck(function, (weight, nis, threshold))


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("temperature", [None, 1.0, 0.01])
def test_value_and_gradient_stay_finite_far_beyond_the_threshold(
    action: str, temperature: float | None
) -> None:
    nis = tensor([0.0, 7.9, 1e12]).requires_grad_()
    threshold = tensor(7.879).requires_grad_()
    soft = None if temperature is None else tensor(temperature)
    weight, _ = Gate(action).weigh(
        tensor([1.0, 0.5, 0.0]), nis, {"gate.threshold": threshold}, soft
    )
    assert bool(((weight >= 0) & (weight <= 1)).all())
    if weight.requires_grad:
        for gradient in torch.autograd.grad(weight.sum(), (nis, threshold), allow_unused=True):
            assert gradient is not None
            assert bool(torch.isfinite(gradient).all())


def test_an_unknown_action_is_an_error_that_lists_the_known() -> None:
    with pytest.raises(InputError, match=r"ignore.*reject, reweigh, inflate"):
        Gate("ignore")
