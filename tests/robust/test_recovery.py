"""Recovery from lock-out: what is counted, and what a count does to one step."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import (
    MATRIX,
    array,
    assert_close,
    linear_filter,
    number,
    one,
    plane_belief,
    tensor,
    textbook_predict,
)
from hypothesis import given
from hypothesis import strategies as st
from oracles import textbook
from recovery_cases import RECOVERIES, after_rejections, axis_filter, three_channels
from torch import Tensor

from difffilter.errors import InputError
from difffilter.parameters.parameters import Values
from difffilter.robust.gate import Gate
from difffilter.robust.recovery import RECOVERIES as ACTIONS
from difffilter.robust.recovery import STREAK, Recovery
from difffilter.weights.registry import huber, tanh

FAR = tensor([500.0, -400.0, 300.0])


def constants(rejections: float, factor: float, temperature: float | None = None) -> Values:
    values = {"recovery.rejections": tensor(rejections), "recovery.factor": tensor(factor)}
    return values if temperature is None else {**values, "temperature": tensor(temperature)}


def test_recovery_is_off_by_default(rng: np.random.Generator) -> None:
    filter = linear_filter(gate=Gate())
    assert filter.recovery is None
    assert not [name for name in filter.declarations if name.startswith("recovery")]
    after, _ = one(filter, plane_belief(rng), FAR)
    assert not after.memory


@pytest.mark.parametrize("action", ACTIONS)
def test_rejections_and_factor_are_parameters_of_the_filter(action: str) -> None:
    filter = axis_filter(Recovery(action, rejections=3, factor=2.5))
    assert number(filter.published()["recovery.rejections"]) == 3.0
    assert number(filter.published()["recovery.factor"]) == 2.5
    with pytest.raises(InputError, match=r"recovery\.factor.*above 1"):
        filter.prepare({"recovery.factor": tensor(1.0)})
    with pytest.raises(InputError, match=r"recovery\.rejections.*above 0"):
        filter.prepare({"recovery.rejections": tensor(0.0)})


def test_an_unknown_action_is_an_error_that_lists_the_known() -> None:
    with pytest.raises(InputError, match=r"reset.*widen, inflate"):
        Recovery("reset")


def test_inflating_where_no_weight_depends_on_the_prediction_is_an_error() -> None:
    with pytest.raises(InputError, match="recovery inflate: expected standardise innovation"):
        axis_filter(Recovery("inflate"), standardise="noise", weight=tanh)
    axis_filter(Recovery("widen"), standardise="noise", weight=tanh)
    axis_filter(Recovery("inflate"), standardise="noise", weight=tanh, iterations=2)


@pytest.mark.parametrize(
    ("weights", "present", "expected"),
    [
        ((0.0, 0.0, 0.0), (True, True, True), (4.0, 4.0)),
        ((0.0, 1.0, 0.0), (True, True, True), (0.0, 4.0)),
        ((0.1, 0.25, 0.5), (True, True, True), (3.0, 2.0)),
        ((0.0, 0.5, 0.0), (False, True, False), (2.0, 3.0)),
        ((0.0, 0.0, 1.0), (True, False, True), (4.0, 0.0)),
        ((0.0, 0.0, 0.0), (False, False, False), (3.0, 3.0)),
    ],
)
def test_a_row_counts_as_far_as_a_groups_best_channel_was_rejected(
    weights: tuple[float, ...], present: tuple[bool, ...], expected: tuple[float, ...]
) -> None:
    streak = tensor([3.0, 3.0])
    found = Recovery().count(streak, tensor(weights), torch.tensor(present), [(0, 1), (2,)])
    assert_close(found, tensor(expected), 1e-14)


@given(rows=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12))
def test_the_count_never_exceeds_the_rows_and_ends_at_an_accepted_channel(
    rows: list[float],
) -> None:
    streak, expected, here = tensor([0.0]), 0.0, torch.tensor([True])
    for i, w in enumerate([*rows, 1.0], start=1):
        streak = Recovery().count(streak, tensor([w]), here, [(0,)])
        expected = (expected + 1.0) * (1.0 - w)
        assert 0.0 <= number(streak) <= i
        assert number(streak) == pytest.approx(expected, abs=1e-12)
    assert number(streak) == 0.0


def test_the_growth_begins_at_the_given_count_and_widening_goes_on_growing() -> None:
    streak = tensor([0.0, 2.0, 3.0, 4.0, 6.0])
    widen = Recovery("widen").growth(streak, constants(3.0, 4.0))
    inflate = Recovery("inflate").growth(streak, constants(3.0, 4.0))
    assert_close(widen, tensor([1.0, 1.0, 4.0, 16.0, 256.0]), 1e-14)
    assert_close(inflate, tensor([1.0, 1.0, 4.0, 4.0, 4.0]), 1e-14)


@pytest.mark.parametrize("action", ACTIONS)
def test_the_soft_growth_becomes_the_hard_one_as_the_temperature_falls(action: str) -> None:
    streak = torch.linspace(0.0, 9.0, 46).double()
    hard = Recovery(action).growth(streak, constants(3.0, 1.5))
    apart = [
        float((Recovery(action).growth(streak, constants(3.0, 1.5, t)) - hard).abs().max())
        for t in (0.1, 0.01, 1e-4)
    ]
    assert apart == sorted(apart, reverse=True)
    assert apart[-1] < 1e-3


@pytest.mark.parametrize("action", ACTIONS)
def test_gradcheck_of_the_soft_growth(action: str) -> None:
    def growth(streak: Tensor, rejections: Tensor, factor: Tensor) -> Tensor:
        known = {"recovery.rejections": rejections, "recovery.factor": factor}
        return Recovery(action).growth(streak, known | {"temperature": tensor(0.5)})

    leaves = [tensor([0.0, 1.5, 3.0, 7.2]), tensor(3.0), tensor(4.0)]
    assert torch.autograd.gradcheck(growth, [x.requires_grad_() for x in leaves])


@pytest.mark.parametrize("iterations", [0, 3])
def test_widening_divides_the_nis_that_gate_and_weight_see(
    rng: np.random.Generator, iterations: int
) -> None:
    options = {"weight": huber, "iterations": iterations, "standardise": "innovation"}
    filter = three_channels(recovery=Recovery("widen", rejections=5, factor=4.0), **options)
    state = plane_belief(rng)
    _, nominal = one(filter, after_rejections(state, 4.0), FAR)
    _, widened = one(filter, after_rejections(state, 6.0), FAR)
    if not iterations:
        assert_close(widened.standardised, nominal.standardised / 4.0, 1e-12)
    assert bool((widened.weight >= nominal.weight).all())
    assert float(widened.weight.sum()) > float(nominal.weight.sum()) + 0.1
    assert torch.equal(widened.observed, nominal.observed)


@pytest.mark.parametrize("scope", ["channel", "all"])
def test_widening_opens_the_gate_exactly_when_the_nis_falls_under_the_threshold(
    rng: np.random.Generator, scope: str
) -> None:
    filter = three_channels(gate=Gate(), recovery=Recovery("widen", 1, 1.2), scope=scope)
    state = plane_belief(rng)
    _, nominal = one(filter, after_rejections(state, 0.0, len(filter.groups)), FAR)
    threshold = number(filter.prepare()["gate.thresholds"][2 if scope == "all" else 0])
    each = nominal.innovation.square() / nominal.innovation_variance
    nis = float(nominal.nis) if scope == "all" else float(each.min())
    needed = int(np.ceil(np.log(nis / threshold) / np.log(1.2)))
    assert needed > 1
    for count, opened in ((needed - 1.0, False), (float(needed), True)):
        _, record = one(filter, after_rejections(state, count, len(filter.groups)), FAR)
        assert bool(record.gate.any()) is opened


@pytest.mark.parametrize("iterations", [0, 3])
def test_inflating_conditions_on_a_grown_prediction_and_leaves_common_noise_alone(
    rng: np.random.Generator, iterations: int
) -> None:
    filter = three_channels(iterations=iterations, recovery=Recovery("inflate", 2, 9.0))
    state = plane_belief(rng)
    mean, cov = textbook_predict(state, 0.5)
    noise = array(filter.prepare()["linear.sigma"])
    for count, grown in ((1.0, 1.0), (2.0, 9.0), (7.0, 9.0)):
        after, record = one(filter, after_rejections(state, count), FAR)
        columns = record.observed[:, -3:]
        assert_close(columns @ columns.mT, noise, 1e-12)
        expected = textbook.kalman_update(
            mean, grown * cov, array(FAR) - MATRIX @ mean, MATRIX, noise
        )
        assert_close(after.mean, expected[0], 1e-10)
        assert_close(after.covariance, expected[1], 1e-9)


@pytest.mark.parametrize("name", list(RECOVERIES))
def test_a_row_without_measurements_leaves_the_count_and_the_prediction(
    rng: np.random.Generator, name: str
) -> None:
    filter = three_channels(gate=Gate(), recovery=RECOVERIES[name])
    state = plane_belief(rng)
    mean, cov = textbook_predict(state, 0.5)
    after, _ = one(filter, after_rejections(state, 7.0), torch.full((3,), torch.nan).double())
    assert after.memory[STREAK].tolist() == [7.0, 7.0, 7.0]
    assert_close(after.mean, mean, 1e-13)
    assert_close(after.covariance, cov, 1e-12)
