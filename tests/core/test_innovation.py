"""NIS and log density of nominal innovations, at any conditioning, against exact fractions."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from helpers import tensor

from difffilter.core.beliefs import Belief, Measurement
from difffilter.core.innovation import log_density, nis
from difffilter.core.linalg import minimum_norm
from difffilter.filters.filter import Filter
from difffilter.filters.stepping import step
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.motions.function import FunctionMotion
from difffilter.running.batch import run
from difffilter.sensors.builtin import Position


@pytest.mark.parametrize("engine", ["torch", "auto"])
@pytest.mark.parametrize("gap", [100.0, 1801.0, 7201.0, 14401.0, 86401.0])
def test_the_nis_is_right_after_any_gap(gap: float, engine: str) -> None:
    a, b = (Position(name=name, axes=1, sigma=0.05) for name in "ab")
    filter = Filter(ConstantVelocity(axes=1), (a, b))
    z = tensor([[0.0, 0.0], [0.0, 0.0], [5.1, 5.0], [5.0, 5.0]])
    log = Log(filter.channels, tensor([0.0, 1.0, gap, gap + 1.0]), z)
    start = Start(tensor([0.0, 0.0]), torch.eye(2).double())
    record = run(filter, log, start=start, engine=engine).record
    assert record is not None
    # S = p 1 1^T + r I: nis = (5.1 - 5)^2 / (2 r) + (5.1 + 5)^2 / (2 (2 p + r))
    p = float(record.observed[2, 0].square().sum())
    expected = 0.1**2 / (2 * 0.0025) + 10.1**2 / (2 * (2 * p + 0.0025))
    assert float(record.nis[2]) == pytest.approx(expected, rel=1e-4)
    exact = Fraction(0.0025) * (2 * Fraction(p) + Fraction(0.0025))
    logarithm = np.log(float(exact)) + 2 * np.log(2 * np.pi)
    assert float(record.log_density[2]) == pytest.approx(-0.5 * (expected + logarithm), rel=1e-4)


def test_they_are_those_of_the_normal_density_over_the_present_channels(
    rng: np.random.Generator,
) -> None:
    z, nu = rng.standard_normal((5, 4, 3)), rng.standard_normal((5, 4))
    r = rng.uniform(0.5, 2.0, (5, 4))
    here = rng.uniform(size=(5, 4)) < 0.6
    here[0] = False
    arguments = (tensor(z), tensor(r), tensor(nu), torch.tensor(here))
    found, density = nis(*arguments), log_density(*arguments)
    for k in range(5):
        own = here[k]
        s = (z[k] @ z[k].T + np.diag(r[k]))[np.ix_(own, own)]
        square = nu[k][own] @ np.linalg.inv(s) @ nu[k][own]
        logarithm = np.linalg.slogdet(2 * np.pi * s)[1]
        assert float(found[k]) == pytest.approx(square, abs=1e-11)
        assert float(density[k]) == pytest.approx(-0.5 * (square + logarithm), abs=1e-11)


@pytest.mark.parametrize(("dtype", "within"), [(torch.float64, 1e-9), (torch.float32, 1e-3)])
@pytest.mark.parametrize("rank", [0, 1, 2])
def test_a_solution_of_least_norm_has_numpys_value_at_any_rank(
    rng: np.random.Generator, rank: int, dtype: torch.dtype, within: float
) -> None:
    for _ in range(20):
        h = rng.standard_normal((3, rank)) @ rng.standard_normal((rank, 2))
        if rank == 2:
            h = np.array([[1.0, 0.2], [0.1, 1.0], [0.3, -0.4]])
        d = rng.standard_normal(3)
        expected = np.linalg.pinv(h, rcond=1e-6) @ d
        found = minimum_norm(torch.tensor(h, dtype=dtype), torch.tensor(d, dtype=dtype))
        size = max(1.0, float(np.abs(expected).max()))
        np.testing.assert_allclose(found.numpy(), expected, rtol=0, atol=within * size)


def test_no_noise_is_added_where_no_time_has_passed() -> None:
    function = FunctionMotion(
        ("x", "y", "vx", "vy"),
        lambda state, dt, inputs, values: state,
        lambda dt, values: torch.eye(4).double().expand(*dt.shape, 4, 4),
    )
    for motion in (ConstantVelocity(2, "state", 1.0), function):
        filter = Filter(motion, (Position(),))
        before = Belief(torch.zeros(4).double(), 10.0 * torch.eye(4).double())
        nothing = Measurement(tensor([torch.nan, torch.nan]), tensor(0.0))
        after, _ = step(filter, filter.prepare(), before, nothing)
        after, _ = step(filter, filter.prepare(), after, nothing)
        np.testing.assert_allclose(after.covariance.numpy(), 100.0 * np.eye(4), atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("small", [1e-3, 3e-4, 1e-6, 1e-9, 1e-30, 0.0])
def test_a_state_that_channels_hardly_see_is_not_moved(small: float, dtype: torch.dtype) -> None:
    h = torch.tensor([[-small, 1.0]] * 3, dtype=dtype)
    found = minimum_norm(h, torch.full((3,), 2.0, dtype=dtype))
    expected = 2.0 / (1.0 + small**2) * torch.tensor([-small, 1.0], dtype=dtype)
    tolerance = 3.0 * (100.0 * torch.finfo(dtype).eps) ** 0.5
    assert torch.allclose(found, expected, rtol=0.0, atol=tolerance)
