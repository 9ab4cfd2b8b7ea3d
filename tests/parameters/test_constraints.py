"""Maps between physical values and unconstrained numbers."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import assert_close, random_spd, tensor
from hypothesis import given
from hypothesis import strategies as st

from difffilter.errors import InputError
from difffilter.parameters.constraints import (
    Above,
    Below,
    Bounded,
    Constraint,
    Covariance,
    Interval,
    OrderedPair,
    Positive,
    Real,
    Simplex,
)

#: Constraint and the number of unconstrained numbers of a value (3 x 3 for a covariance).
KINDS: list[tuple[Constraint, int]] = [
    (Real(), 3),
    (Positive(), 3),
    (Positive(zero=(0, 3)), 3),
    (Above(1.0), 3),
    (Below(2.0), 3),
    (Interval(), 3),
    (Interval(-5.0, 2.0), 3),
    (OrderedPair(), 2),
    (Simplex(), 3),
    (Covariance(), 6),
]
IDS = [repr(kind) for kind, _ in KINDS]


@pytest.mark.parametrize(("constraint", "size"), KINDS, ids=IDS)
@given(data=st.data())
def test_any_unconstrained_numbers_give_an_admitted_value_and_come_back(
    constraint: Constraint, size: int, data: st.DataObject
) -> None:
    free = tensor(data.draw(st.lists(st.floats(-6, 6), min_size=size, max_size=size)))
    physical = constraint.physical(free)
    assert constraint.admits(physical)
    if not isinstance(constraint, Covariance):
        assert_close(constraint.free(physical) + 10, free + 10, 1e-9)
    assert_close(constraint.physical(constraint.free(physical)), physical, 1e-9)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("constraint", "size"), KINDS, ids=IDS)
def test_what_the_map_gives_is_admitted_in_either_precision(
    constraint: Constraint, size: int, dtype: torch.dtype, generator: torch.Generator
) -> None:
    for _ in range(40):
        free = torch.randn(size, generator=generator).to(dtype)
        physical = constraint.physical(free)
        assert physical.dtype == dtype
        assert constraint.admits(physical)


@pytest.mark.parametrize(
    ("constraint", "value"),
    [
        (Real(), -3.5),
        (Positive(), (1e-9, 1e9)),
        (Positive(zero=(1,)), (1e-9, 0.0, 1e9)),
        (Positive(zero=(0, 1)), (0.0, 0.0)),
        (Above(1.0), (1.5, 1e6)),
        (Above(-3.0), -2.0),
        (Below(2.0), (1.5, -1e6)),
        (Below(-3.0), -4.0),
        (Interval(), (1e-6, 0.5, 1 - 1e-6)),
        (OrderedPair(), (1.5, 4.0)),
        (OrderedPair(), (1e-3, 1e3)),
        (Simplex(), (0.2, 0.3, 0.5)),
        (Covariance(), ((4.0, 1.0), (1.0, 0.5))),
        (Covariance(), ((1e6, 1e-3), (1e-3, 1e-6))),
    ],
)
def test_a_physical_value_survives_the_round_trip(constraint: Constraint, value: object) -> None:
    physical = torch.tensor(value, dtype=torch.float64)
    assert constraint.admits(physical)
    again = constraint.physical(constraint.free(physical))
    torch.testing.assert_close(again, physical, rtol=1e-12, atol=0.0)


@pytest.mark.parametrize(
    ("constraint", "value"),
    [
        (Real(), float("nan")),
        (Real(), (1.0, float("inf"))),
        (Positive(), 0.0),
        (Positive(), (1.0, -1e-9)),
        (Positive(), float("inf")),
        (Positive(zero=(1,)), (1.0, 1e-9)),
        (Positive(zero=(1,)), (0.0, 0.0)),
        (Positive(zero=(1,)), (1.0, 0.0, -2.0)),
        (Above(1.0), 1.0),
        (Above(1.0), (2.0, 0.5)),
        (Above(1.0), float("inf")),
        (Below(2.0), 2.0),
        (Below(2.0), (1.0, 3.0)),
        (Below(2.0), float("-inf")),
        (Interval(), 0.0),
        (Interval(), (0.5, 1.0)),
        (Interval(-5.0, 2.0), 2.5),
        (OrderedPair(), (4.0, 1.5)),
        (OrderedPair(), (2.0, 2.0)),
        (OrderedPair(), (0.0, 1.0)),
        (OrderedPair(), 1.0),
        (OrderedPair(), (1.0, 2.0, 3.0)),
        (Simplex(), (0.5, 0.6)),
        (Simplex(), (1.0, 0.0)),
        (Simplex(), (1.5, -0.5)),
        (Simplex(), (1.0,)),
        (Simplex(), 1.0),
        (Covariance(), ((1.0, 0.5), (0.4, 1.0))),
        (Covariance(), ((1.0, 2.0), (2.0, 1.0))),
        (Covariance(), ((0.0, 0.0), (0.0, 1.0))),
        (Covariance(), ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))),
        (Covariance(), (1.0, 2.0)),
        (Covariance(), ((float("nan"), 0.0), (0.0, 1.0))),
    ],
)
def test_a_value_outside_the_set_is_not_admitted(constraint: Constraint, value: object) -> None:
    assert not constraint.admits(torch.tensor(value, dtype=torch.float64))


@pytest.mark.parametrize(("constraint", "size"), KINDS, ids=IDS)
def test_the_map_to_physical_values_passes_gradcheck(
    constraint: Constraint, size: int, generator: torch.Generator
) -> None:
    free = torch.randn(size, generator=generator, dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(constraint.physical, free)


@pytest.mark.parametrize(("constraint", "size"), KINDS, ids=IDS)
def test_a_value_under_differentiation_is_checked_without_a_warning(
    constraint: Constraint, size: int
) -> None:
    free = torch.zeros(size, dtype=torch.float64).requires_grad_()
    torch.set_warn_always(True)  # torch warns once per process otherwise
    try:
        assert constraint.admits(constraint.physical(free))
    finally:
        torch.set_warn_always(False)


@pytest.mark.parametrize(
    ("constraint", "values"),
    [
        (Bounded(), (0.0, 1e-9, 3.0, 1e9)),
        (Bounded(scale=10.0), (0.0, 4.0)),
        (Bounded(high=1.0, scale=0.3), (0.0, 0.25, 1.0)),
        (Bounded(-2.0, 5.0), (-2.0, 0.0, 5.0)),
    ],
)
def test_bounded_admits_its_bounds_and_brings_values_back(
    constraint: Bounded, values: tuple[float, ...]
) -> None:
    physical = tensor(values)
    assert constraint.admits(physical)
    assert_close(constraint.physical(constraint.free(physical)), physical, 1e-15)
    assert constraint.free(physical).tolist() == pytest.approx(
        (physical / constraint.scale).tolist()
    )


@given(free=st.floats(-50, 50), scale=st.floats(0.1, 20))
def test_bounded_clips_and_what_it_gives_is_admitted(free: float, scale: float) -> None:
    constraint = Bounded(-1.0, 2.0, scale)
    found = constraint.physical(tensor(free))
    assert constraint.admits(found)
    assert float(found) == pytest.approx(min(max(scale * free, -1.0), 2.0), abs=1e-12)


@pytest.mark.parametrize("free", [-3.0, 0.0, 0.2, 1 / 0.3, 9.0])
def test_a_value_on_a_bound_of_bounded_can_leave_it_again(free: float) -> None:
    """The gradient is that of the unclipped number, on the bound and beyond."""
    constraint = Bounded(high=1.0, scale=0.3)
    leaf = tensor(free).requires_grad_()
    (gradient,) = torch.autograd.grad(constraint.physical(leaf), leaf)
    assert float(gradient) == pytest.approx(0.3)


def test_bounded_refuses_what_lies_outside_and_says_what_it_expects() -> None:
    constraint = Bounded(high=1.0)
    for value in (-1e-12, 1.0 + 1e-12, float("nan"), float("inf")):
        assert not constraint.admits(tensor(value))
    assert not Bounded().admits(tensor(-1e-300))
    assert not Bounded().admits(tensor([1.0, float("inf")]))
    assert constraint.expected() == "a number from 0 to 1"
    assert Bounded(low=2.0).expected() == "a number of 2 or more"


def test_a_random_covariance_survives_the_round_trip(rng: np.random.Generator) -> None:
    for n in (1, 2, 5):
        covariance = random_spd(rng, n)
        free = Covariance().free(tensor(covariance))
        assert free.shape == (n * (n + 1) // 2,)
        assert_close(Covariance().physical(free), covariance, 1e-13)


def test_simplex_has_one_number_less_than_its_value() -> None:
    assert Simplex().free(tensor([0.2, 0.3, 0.5])).shape == (2,)
    assert_close(Simplex().physical(torch.zeros(2).double()), tensor([1 / 3] * 3), 1e-15)


def test_every_constraint_says_what_it_expects() -> None:
    sentences = {constraint.expected() for constraint, _ in KINDS}
    assert len(sentences) == len(KINDS)
    assert Interval(-5.0, 2.0).expected() == "a number between -5 and 2"
    assert Above(1.0).expected() == "a number above 1"
    assert Below(2.0).expected() == "a number below 2"
    assert Positive(zero=(0, 3)).expected() == "numbers above 0, and 0 at 1, 4"


def test_a_tuned_covariance_stays_admissible_and_well_scaled() -> None:
    """Adam at 0.1 from 1e-6 I, towards samples of the same scale, and after a step of any size."""
    free = Covariance().free(1e-6 * torch.eye(6, dtype=torch.float64)).requires_grad_()
    optimiser = torch.optim.Adam([free], lr=0.1)
    draw = torch.Generator().manual_seed(1)
    for _ in range(200):
        optimiser.zero_grad()
        x = 1e-3 * torch.randn(6, 64, generator=draw, dtype=torch.float64)
        covariance = Covariance().physical(free)
        cost = torch.logdet(covariance) + (x * torch.linalg.solve(covariance, x)).sum(0).mean()
        cost.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        now = Covariance().physical(free.detach())
        assert Covariance().admits(now)
        eigenvalues = torch.linalg.eigvalsh(now)
        assert float(eigenvalues[0]) > 1e-7
        assert float(eigenvalues[-1]) < 1e-5
    far = 1e3 * torch.randn(21, generator=draw, dtype=torch.float64)
    far[[0, 2, 5, 9, 14, 20]] = 0.0
    assert Covariance().admits(Covariance().physical(far))


def test_correlations_of_one_are_no_free_numbers() -> None:
    with pytest.raises(InputError, match="correlations of 1 to within"):
        Covariance().free(
            torch.tensor([[1.0, 1.0 - 1e-12], [1.0 - 1e-12, 1.0]], dtype=torch.float64)
        )
