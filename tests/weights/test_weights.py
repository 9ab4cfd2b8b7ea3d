"""Weight functions: shape, limits and agreement with their published forms."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from helpers import assert_close, tensor
from hypothesis import given
from hypothesis import strategies as st
from oracles import weights as published
from weight_cases import NAMES, TEMPERATURES, Numbers, clipping_points, evaluate, values_of

from difffilter.errors import InputError
from difffilter.weights.registry import WEIGHTS

ORACLES: dict[str, Callable[..., np.ndarray]] = {
    name: getattr(published, name.replace("-", "_")) for name in NAMES
}
#: Close to, and far from, the limits of barron's shape.
SHAPES = st.one_of(st.floats(-20.0, 1.99), st.sampled_from([2 - 1e-12, 1.0, -1e3, -1e12]))


def numbers_for(name: str) -> st.SearchStrategy[Numbers]:
    """Parameters around the literature's."""
    if name == "plain":
        return st.just(())
    if name == "barron":
        return st.tuples(SHAPES, st.floats(0.3, 6.0))
    if name in ("igg3", "tanh"):
        pairs = st.tuples(st.floats(0.5, 2.5), st.floats(0.5, 6.0))
        return pairs.map(lambda p: (p[0], p[0] + p[1]))
    return st.tuples(st.floats(0.3, 6.0))


CASES = st.sampled_from(NAMES).flatmap(lambda name: st.tuples(st.just(name), numbers_for(name)))
SIZES = st.one_of(st.floats(0.0, 20.0), st.floats(0.0, 1e6))


@given(case=CASES, sizes=st.lists(SIZES, min_size=1), temperature=st.sampled_from(TEMPERATURES))
def test_a_weight_is_even_between_0_and_1_and_never_rises_with_the_residual(
    case: tuple[str, Numbers], sizes: list[float], temperature: float | None
) -> None:
    name, numbers = case
    grid = torch.cat([tensor(sorted(sizes)), torch.linspace(0, 12, 241).double()]).sort().values
    w = evaluate(name, grid, temperature, numbers)
    assert torch.equal(w, evaluate(name, -grid, temperature, numbers))
    assert bool((w >= 0).all())
    assert float(w.max()) <= 1 + 1e-14
    assert float(w.diff().max()) <= 1e-12


@given(case=CASES, temperature=st.sampled_from(TEMPERATURES))
def test_a_residual_of_zero_has_weight_one(
    case: tuple[str, Numbers], temperature: float | None
) -> None:
    w = evaluate(case[0], tensor([0.0]), temperature, case[1])
    assert float(w) == pytest.approx(1.0, abs=1e-12)


@given(case=CASES, temperature=st.sampled_from(TEMPERATURES), dtype=st.sampled_from(["f4", "f8"]))
def test_value_and_gradient_are_finite_at_zero_at_each_clipping_point_and_far_out(
    case: tuple[str, Numbers], temperature: float | None, dtype: str
) -> None:
    name, numbers = case
    kind = torch.float32 if dtype == "f4" else torch.float64
    weight = WEIGHTS[name]
    values = {k: v.to(kind).requires_grad_() for k, v in values_of(weight, numbers).items()}
    s = clipping_points(name, numbers).to(kind).requires_grad_()
    soft = None if temperature is None else torch.tensor(temperature, dtype=kind)
    w = weight(s, weight.prepare(values), soft)
    assert w.dtype == kind
    assert bool(torch.isfinite(w).all())
    if name == "plain":
        assert torch.equal(w, torch.ones_like(s))
        return
    for gradient in torch.autograd.grad(w.sum(), [s, *values.values()]):
        assert bool(torch.isfinite(gradient).all())


@given(case=CASES, sizes=st.lists(SIZES, min_size=1))
def test_the_hard_form_is_the_published_one(case: tuple[str, Numbers], sizes: list[float]) -> None:
    s = np.concatenate([sizes, -np.array(sizes), np.linspace(-9, 9, 181)])
    expected = ORACLES[case[0]](s, *case[1])
    assert_close(evaluate(case[0], tensor(s), None, case[1]), expected, 1e-10)


@pytest.mark.parametrize("numbers", [(1.5, 4.0), (0.5, 0.6), (3.0, 20.0), (0.1, 9.0)])
def test_the_tanh_slope_solves_its_equation(numbers: tuple[float, float]) -> None:
    a, b = numbers
    weight = WEIGHTS["tanh"]
    c = float(weight.prepare(values_of(weight, numbers))["tanh.c"])
    assert c > 0
    assert c * np.tanh(0.5 * c * (b - a)) == pytest.approx(a, rel=1e-12)
    assert c == pytest.approx(published.tanh_slope(a, b), rel=1e-12)


@given(a=st.floats(0.01, 10.0), gap=st.floats(0.01, 50.0))
def test_the_tanh_slope_is_found_for_any_clipping_points(a: float, gap: float) -> None:
    weight = WEIGHTS["tanh"]
    c = float(weight.prepare(values_of(weight, (a, a + gap)))["tanh.c"])
    gap = (a + gap) - a
    assert c * np.tanh(0.5 * c * gap) == pytest.approx(a, rel=1e-10)


@pytest.mark.parametrize("numbers", [(1.5, 4.0), (0.5, 0.6), (3.0, 20.0)])
def test_the_implicit_gradient_of_the_slope_matches_finite_differences(
    numbers: tuple[float, float],
) -> None:
    weight = WEIGHTS["tanh"]
    ab = tensor(numbers).requires_grad_()
    slope = weight.prepare({"tanh.ab": ab})["tanh.c"]
    (found,) = torch.autograd.grad(slope, ab)
    h = 1e-6
    for i in range(2):
        up, down = (
            published.tanh_slope(*(np.array(numbers) + sign * h * np.eye(2)[i])) for sign in (1, -1)
        )
        assert float(found[i]) == pytest.approx((up - down) / (2 * h), rel=1e-6)


def test_an_unknown_weight_is_an_error_that_lists_the_known() -> None:
    assert WEIGHTS["huber"].name == "huber"
    with pytest.raises(InputError, match=r"hubber.*huber"):
        WEIGHTS["hubber"]


@pytest.mark.parametrize("temperature", TEMPERATURES)
@pytest.mark.parametrize("name", NAMES)
def test_leading_dimensions_do_not_change_a_weight(name: str, temperature: float | None) -> None:
    s = torch.linspace(-6, 6, 24).double()
    batch = evaluate(name, s.reshape(2, 3, 4), temperature)
    assert_close(batch.reshape(24), evaluate(name, s, temperature), 1e-15)
