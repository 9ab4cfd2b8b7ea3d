"""Factors of covariances that may be singular."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import assert_close, random_spd, tensor
from hypothesis import given
from hypothesis import strategies as st

from difffilter.core.compression import compress
from difffilter.core.linalg import positive_sqrt, semidefinite_cholesky


def test_a_definite_matrix_gives_the_ordinary_cholesky_factor(rng: np.random.Generator) -> None:
    covariance = random_spd(rng, 5, 3, 2)
    assert_close(semidefinite_cholesky(tensor(covariance)), np.linalg.cholesky(covariance), 1e-13)


def test_the_prescribed_singular_start_is_factored_exactly() -> None:
    covariance = torch.diag(tensor([1e6, 0.0, 1e6, 0.0]))
    assert torch.equal(semidefinite_cholesky(covariance), torch.diag(tensor([1e3, 0, 1e3, 0])))


def test_scales_of_the_states_do_not_decide_what_counts_as_zero() -> None:
    covariance = torch.diag(tensor([1e20, 1e-20]))
    assert_close(semidefinite_cholesky(covariance), torch.diag(tensor([1e10, 1e-10])), 1e-15)
    assert float(semidefinite_cholesky(covariance)[1, 1]) == pytest.approx(1e-10)


@given(
    n=st.integers(1, 6), rank=st.integers(0, 6), seed=st.integers(0, 10_000), log=st.floats(-6, 6)
)
def test_the_factor_reproduces_a_matrix_of_any_rank(
    n: int, rank: int, seed: int, log: float
) -> None:
    root = 10.0**log * np.random.default_rng(seed).standard_normal((n, rank))
    covariance = root @ root.T
    lower = semidefinite_cholesky(tensor(covariance))
    assert_close(lower @ lower.mT, covariance, 1e-9)  # unpivoted: low rank costs digits
    assert torch.equal(lower, lower.tril())
    assert bool((lower.diagonal() >= 0).all())


def test_an_indefinite_remainder_below_rounding_leaves_a_real_factor() -> None:
    covariance = tensor([[1.0, 1.0], [1.0, 1.0 - 1e-16]])
    covariance[1, 1] -= 1.2e-16
    lower = semidefinite_cholesky(covariance)
    assert float(lower[1, 1]) == 0.0
    assert_close(lower @ lower.mT, covariance, 1e-15)


@pytest.mark.parametrize("diagonal", [(1e6, 0.0, 1e6, 0.0), (0.0, 0.0, 0.0, 0.0)])
def test_the_gradient_at_a_singular_matrix_is_finite(diagonal: tuple[float, ...]) -> None:
    covariance = torch.diag(tensor(diagonal)).requires_grad_()
    semidefinite_cholesky(covariance).sum().backward()
    assert covariance.grad is not None
    assert bool(torch.isfinite(covariance.grad).all())


def test_the_gradient_of_the_factor_passes_gradcheck(rng: np.random.Generator) -> None:
    root = tensor(rng.standard_normal((2, 4, 4))).requires_grad_()
    assert torch.autograd.gradcheck(lambda x: semidefinite_cholesky(x @ x.mT), root)


def test_the_gradient_is_right_along_the_range_of_a_singular_matrix() -> None:
    column = tensor([[1.0], [-2.0], [0.5]])

    def gram(column: torch.Tensor) -> torch.Tensor:
        lower = semidefinite_cholesky(column @ column.mT)
        return lower @ lower.mT

    scale = tensor(1.7).requires_grad_()
    assert torch.autograd.gradcheck(lambda s: gram(s * column), scale)
    expected = 2 * 1.7 * column @ column.mT
    assert_close(torch.func.jacrev(lambda s: gram(s * column))(scale), expected, 1e-12)


@pytest.mark.parametrize("k", [1, 3, 4, 9])
def test_compress_keeps_the_gram_matrix_in_square_form(rng: np.random.Generator, k: int) -> None:
    deviations = tensor(rng.standard_normal((2, 3, 4, k)))
    square = compress(deviations)
    assert square.shape == (2, 3, 4, 4)
    # A Gram matrix of low rank, factored without pivoting, costs some digits.
    tolerance = 1e-13 if k >= 4 else 1e-9
    assert_close(square @ square.mT, deviations @ deviations.mT, tolerance)


@pytest.mark.parametrize("rank", [4, 2, 0])
def test_the_written_gradient_of_compress_equals_autograd(
    rng: np.random.Generator, rank: int
) -> None:
    # Exact zeros beyond the rank: the pivots there are zero, not rounding errors.
    moved = tensor(rng.standard_normal((3, 4, 4)))
    process = tensor(rng.standard_normal((4, 2)))
    moved[:, rank:], process[rank:] = 0.0, 0.0
    blocks = [moved.requires_grad_(), process.requires_grad_()]
    bar = tensor(rng.standard_normal((3, 4, 4)))
    written = compress(*blocks)
    plain = semidefinite_cholesky(moved @ moved.mT + process @ process.mT)
    assert_close(written, plain.detach(), 1e-13)
    found = torch.autograd.grad(written, blocks, bar)
    expected = torch.autograd.grad(plain, blocks, bar)
    for a, b in zip(found, expected, strict=True):
        assert_close(a, b, 1e-11)


def test_float32_stays_float32(rng: np.random.Generator) -> None:
    covariance = random_spd(rng, 4)
    lower = semidefinite_cholesky(tensor(covariance).float())
    assert lower.dtype == torch.float32
    assert_close((lower @ lower.mT).double(), covariance, 1e-6)


def test_positive_sqrt_is_the_root_with_zero_gradient_at_zero() -> None:
    x = tensor([0.0, 1e-12, 4.0]).requires_grad_()
    root = positive_sqrt(x)
    root.sum().backward()
    assert_close(root, tensor([0.0, 1e-6, 2.0]), 1e-15)
    assert x.grad is not None
    assert_close(x.grad, tensor([0.0, 5e5, 0.25]), 1e-12)
