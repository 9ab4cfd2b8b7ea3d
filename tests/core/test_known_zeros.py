"""Entries of a vector that are known to be 0: neither tuned nor moved."""

from __future__ import annotations

import pytest
import torch
from helpers import array, assert_close, number, tensor
from hypothesis import given
from hypothesis import strategies as st

from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter, ParameterSet, declare
from difffilter.running.batch import run
from difffilter.sensors.builtin import Position

ENTRIES = st.lists(st.one_of(st.just(0.0), st.floats(1e-6, 1e6)), min_size=1, max_size=6).filter(
    any
)


def filter_from(sigma: tuple[float, ...], tuned: bool = True) -> Filter:
    filter = Filter(ConstantVelocity(2), (Position(sigma=2.0),), start_sigma=sigma)
    declared = filter.declarations["start.sigma"]
    fields = {"value": declared.value, "constraint": declared.constraint, "tuned": tuned}
    override = Parameter("start.sigma", **fields)  # type: ignore[arg-type]
    return Filter(
        ConstantVelocity(2),
        (Position(sigma=2.0),),
        start_sigma=sigma,
        overrides={"start.sigma": override},
    )


@given(entries=ENTRIES, moves=st.lists(st.floats(-3, 3), min_size=6, max_size=6))
def test_zeros_stay_exactly_zero_wherever_the_optimiser_goes(
    entries: list[float], moves: list[float]
) -> None:
    zero = tuple(i for i, entry in enumerate(entries) if entry == 0.0)
    declared = declare([Parameter("v", tuple(entries), Positive(zero), tuned=True)])
    parameters = ParameterSet(declared)
    assert_close(parameters.values()["v"], tensor(entries), 1e-12)
    (free,) = parameters.free().values()
    kept = [i for i in range(len(entries)) if i not in zero]
    assert free.shape == (len(kept),)
    with torch.no_grad():
        free += tensor(moves[: len(kept)])
    moved = array(parameters.values()["v"])
    assert (moved[list(zero)] == 0.0).all()
    factors = array(tensor(moves[: len(kept)]).exp())
    assert moved[kept] == pytest.approx(tensor(entries)[kept].numpy() * factors, rel=1e-9)
    assert declared["v"].constraint.admits(parameters.values()["v"])


@given(free=st.lists(st.floats(-6, 6), min_size=3, max_size=3))
def test_each_free_number_moves_its_own_entry_alone(free: list[float]) -> None:
    jacobian = torch.autograd.functional.jacobian(
        Positive(zero=(0, 2)).physical, tensor(free), create_graph=False
    )
    expected = torch.zeros(5, 3).double()
    for column, row in enumerate((1, 3, 4)):
        expected[row, column] = tensor(free[column]).exp()
    assert_close(jacobian, expected, 1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_start_known_in_part_has_a_finite_gradient_through_a_run(dtype: torch.dtype) -> None:
    filter = filter_from((5.0, 0.0, 2.0, 0.0))
    parameters = ParameterSet(filter.declarations, dtype=dtype)
    z = torch.randn(6, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    start = Start(torch.zeros(4).double())
    log = Log(filter.channels, torch.arange(6.0).double(), z, start=start).to(dtype)
    optimiser = torch.optim.SGD(parameters.parameters(), lr=0.1)
    track = run(filter, log, parameters.values())
    loss = track.mean.square().mean() + track.covariance.diagonal(dim1=-2, dim2=-1).sum()
    loss.backward()  # type: ignore[no-untyped-call]
    (free,) = parameters.free().values()
    assert free.grad is not None
    assert free.grad.shape == (2,)
    assert bool(torch.isfinite(free.grad).all())
    assert bool((free.grad != 0).all())
    optimiser.step()
    after = parameters.frozen_values()["start.sigma"]
    assert after[[1, 3]].tolist() == [0.0, 0.0]
    assert bool((after[[0, 2]] != tensor([5.0, 2.0]).to(dtype)).all())


def test_a_state_known_exactly_starts_without_variance() -> None:
    filter = filter_from((5.0, 0.0, 2.0, 0.0))
    log = Log(
        filter.channels,
        torch.zeros(1).double(),
        tensor([[4.0, 3.0]]),
        start=Start(torch.zeros(4).double()),
    )
    track = run(filter, log)
    assert number(track.mean[0, 0]) == pytest.approx(4.0 * 25 / 29)
    assert number(track.mean[0, 1]) == 0.0
    assert track.std[0].tolist()[1::2] == [0.0, 0.0]


@pytest.mark.parametrize("value", [(5.0, 1.0, 2.0, 0.0), (0.0, 0.0, 2.0, 0.0)])
def test_other_zeros_than_the_declared_ones_are_an_error(value: tuple[float, ...]) -> None:
    filter = filter_from((5.0, 0.0, 2.0, 0.0))
    with pytest.raises(InputError, match=r"start\.sigma.*numbers above 0, and 0 at 2, 4"):
        filter.prepare({"start.sigma": tensor(value)})


def test_a_start_that_is_known_wholly_has_nothing_to_tune() -> None:
    parameters = ParameterSet(filter_from((0.0, 0.0, 0.0, 0.0)).declarations)
    (free,) = parameters.free().values()
    assert free.shape == (0,)
    assert parameters.values()["start.sigma"].tolist() == [0.0] * 4
