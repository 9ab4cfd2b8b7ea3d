"""The chi-square gate: hard, soft, and the three actions."""

from __future__ import annotations

import pytest
import torch
from helpers import assert_close, tensor
from oracles import chi_square
from torch import Tensor

from difffilter.errors import InputError
from difffilter.robust.gate import ACTIONS, Gate

NIS = tensor([0.0, 3.0, 7.879, 7.880, 20.0, 1e6])
WEIGHT = tensor([1.0, 0.9, 0.8, 0.7, 0.5, 0.0])


def constants(threshold: float | Tensor | None = None, most: int = 1) -> dict[str, Tensor]:
    """Of a gate with this threshold for one degree of freedom, or the default one."""
    if threshold is None:
        threshold = Gate().parameters[0].tensor()
    value = threshold if isinstance(threshold, Tensor) else tensor(threshold)
    return Gate().prepare({"gate.threshold": value}, most)


def weigh(
    action: str, temperature: float | None = None, share: float | Tensor = 1.0
) -> tuple[Tensor, Tensor]:
    soft = None if temperature is None else tensor(temperature)
    return Gate(action).weigh(WEIGHT, NIS, None, constants(), soft, share)


def passed(nis: Tensor, threshold: float, temperature: float | None = None) -> Tensor:
    soft = None if temperature is None else tensor(temperature)
    return Gate().weigh(torch.ones_like(nis), nis, None, constants(threshold), soft)[1]


def test_the_hard_gate_passes_up_to_the_threshold_and_not_beyond() -> None:
    nis = tensor([0.0, 4.0, 4.0 + 1e-12, 1e9])
    assert torch.equal(passed(nis, 4.0), tensor([1.0, 1.0, 0.0, 0.0]))


def test_reject_leaves_weight_only_to_what_passes() -> None:
    weight, passed = weigh("reject")
    assert torch.equal(passed, tensor([1, 1, 1, 0, 0, 0]))
    assert torch.equal(weight, tensor([1.0, 0.9, 0.8, 0.0, 0.0, 0.0]))


def test_reweigh_uses_the_robust_weight_only_on_what_fails() -> None:
    weight, passed = weigh("reweigh")
    assert torch.equal(passed, tensor([1, 1, 1, 0, 0, 0]))
    assert torch.equal(weight, tensor([1.0, 1.0, 1.0, 0.7, 0.5, 0.0]))


def test_inflate_grows_r_by_the_excess_times_the_innovation_variance() -> None:
    """R / w = R + (e / threshold - 1) S: of S = 1 here, R is the share."""
    share = torch.linspace(0.1, 1.0, 6).double()
    weight, passed = weigh("inflate", share=share)
    threshold = Gate().parameters[0].tensor()
    inflated = share + (NIS / threshold - 1.0).clamp_min(0.0)
    assert torch.equal(passed, tensor([1, 1, 1, 0, 0, 0]))
    assert_close(weight, WEIGHT * share / inflated, 1e-14)


def test_inflate_of_a_channel_that_is_all_noise_weighs_by_threshold_over_nis() -> None:
    weight, _ = weigh("inflate")
    threshold = Gate().parameters[0].tensor()
    assert_close(weight, WEIGHT * (threshold / NIS.clamp_min(1.0)).clamp_max(1.0), 1e-14)


@pytest.mark.parametrize("action", ACTIONS)
def test_each_channel_is_tested_with_the_degrees_of_its_group(action: str) -> None:
    limits = tensor([chi_square.quantile(0.005, d) for d in (1, 2, 5)])
    nis = torch.cat([limits * (1 - 1e-9), limits * (1 + 1e-9)])
    degrees = torch.tensor([1, 2, 5, 1, 2, 5])
    _, passed = Gate(action).weigh(torch.ones(6).double(), nis, degrees, constants(most=5), None)
    assert passed.tolist() == [1, 1, 1, 0, 0, 0]


def test_a_group_without_channels_passes() -> None:
    nothing = torch.zeros(1).double()
    degrees = torch.zeros(1, dtype=torch.long)
    _, passed = Gate().weigh(nothing, nothing, degrees, constants(most=3), None)
    assert float(passed) == 1.0


@pytest.mark.parametrize("action", ACTIONS)
def test_the_soft_gate_becomes_the_hard_one_as_the_temperature_falls(action: str) -> None:
    hard, _ = weigh(action)
    soft, passed = weigh(action, 1e-6)
    assert_close(soft, hard, 1e-12)
    assert bool(((passed >= 0) & (passed <= 1)).all())


def test_the_soft_gate_is_one_half_at_the_threshold_and_falls_with_the_nis() -> None:
    expected = torch.sigmoid(tensor([1.5, 0.0, -1.0]))
    assert_close(passed(tensor([1.0, 4.0, 6.0]), 4.0, 2.0), expected, 1e-15)


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("temperature", [1.0, 0.1])
def test_gradcheck_passes_over_weight_nis_threshold_and_share(
    action: str, temperature: float
) -> None:
    nis = tensor([0.0, 3.9, 4.3, 5.0, 5.5]).requires_grad_()
    weight = tensor([1.0, 0.9, 0.6, 0.2, 0.7]).requires_grad_()
    share = tensor([0.2, 0.4, 0.6, 0.8, 1.0]).requires_grad_()
    threshold = tensor(4.0).requires_grad_()
    degrees = torch.tensor([1, 1, 1, 1, 2])

    def function(
        weight: Tensor, nis: Tensor, threshold: Tensor, share: Tensor
    ) -> tuple[Tensor, Tensor]:
        known = constants(threshold, 2)
        return Gate(action).weigh(weight, nis, degrees, known, tensor(temperature), share)

    assert torch.autograd.gradcheck(function, (weight, nis, threshold, share))


@pytest.mark.parametrize("action", ACTIONS)
@pytest.mark.parametrize("temperature", [None, 1.0, 0.01])
def test_value_and_gradient_stay_finite_far_beyond_the_threshold(
    action: str, temperature: float | None
) -> None:
    nis = tensor([0.0, 7.9, 1e12]).requires_grad_()
    threshold = tensor(7.879).requires_grad_()
    soft = None if temperature is None else tensor(temperature)
    known = constants(threshold)
    weight, _ = Gate(action).weigh(tensor([1.0, 0.5, 0.0]), nis, None, known, soft)
    assert bool(((weight >= 0) & (weight <= 1)).all())
    if weight.requires_grad:
        for gradient in torch.autograd.grad(weight.sum(), (nis, threshold), allow_unused=True):
            assert gradient is not None
            assert bool(torch.isfinite(gradient).all())


def test_an_unknown_action_is_an_error_that_lists_the_known() -> None:
    with pytest.raises(InputError, match=r"ignore.*reject, reweigh, inflate"):
        Gate("ignore")
