"""The one measurement update against the textbook joint update."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from condition_cases import random_problem, with_columns
from helpers import array, assert_close, random_spd, tensor
from hypothesis import given
from hypothesis import strategies as st
from oracles.regression import weighted_noise
from oracles.textbook import kalman_update
from torch import Tensor

from difffilter.core.conditioning import condition
from difffilter.core.equations import Conditioned


def covariance(conditioned: Conditioned) -> Tensor:
    return conditioned.deviations @ conditioned.deviations.mT


def textbook(
    deviations: Tensor, rows: Tensor, innovation: Tensor, noise: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Shift and covariance of the joint update with a full R."""
    x = array(deviations)
    prior = x @ np.swapaxes(x, -1, -2)
    return kalman_update(np.zeros(x.shape[:-1]), prior, array(innovation), array(rows), noise)


def diagonal(values: Tensor) -> np.ndarray:
    return array(torch.diag_embed(values))


@pytest.mark.parametrize("batch", [(), (5,), (2, 3)])
def test_channel_by_channel_equals_the_joint_update(
    rng: np.random.Generator, batch: tuple[int, ...]
) -> None:
    deviations, rows, innovation, _, noise = random_problem(rng, batch=batch)
    done = condition(deviations, rows @ deviations, innovation, torch.ones_like(noise), noise)
    shift, posterior = textbook(deviations, rows, innovation, diagonal(noise))
    assert_close(done.shift, shift, 1e-12)
    assert_close(covariance(done), posterior, 1e-12)
    after = innovation - (rows @ done.shift.unsqueeze(-1)).squeeze(-1)
    assert_close(done.residual, after, 1e-12)


def test_a_weight_divides_the_noise_of_its_channel(rng: np.random.Generator) -> None:
    deviations, rows, innovation, weight, noise = random_problem(rng, batch=(4,))
    done = condition(deviations, rows @ deviations, innovation, weight, noise)
    shift, posterior = textbook(deviations, rows, innovation, diagonal(noise / weight))
    assert_close(done.shift, shift, 1e-12)
    assert_close(covariance(done), posterior, 1e-12)


@pytest.mark.parametrize("channel", [0, 1, 2])
def test_weight_zero_deletes_the_channel_whatever_it_measured(
    rng: np.random.Generator, channel: int
) -> None:
    deviations, rows, innovation, weight, noise = random_problem(rng)
    weight[channel], innovation[channel] = 0.0, 1e9
    kept = [i for i in range(3) if i != channel]
    done = condition(deviations, rows @ deviations, innovation, weight, noise)
    less = condition(
        deviations, (rows @ deviations)[kept], innovation[kept], weight[kept], noise[kept]
    )
    assert_close(done.shift, less.shift, 1e-14)
    assert_close(done.deviations, less.deviations, 1e-14)
    assert_close(done.residual[kept], less.residual, 1e-14)


def test_all_weights_zero_leave_the_prior_untouched(rng: np.random.Generator) -> None:
    deviations, rows, innovation, weight, noise = random_problem(rng)
    done = condition(deviations, rows @ deviations, innovation, 0 * weight, noise)
    assert torch.equal(done.shift, torch.zeros(4, dtype=torch.float64))
    assert torch.equal(done.deviations, deviations)
    assert torch.equal(done.residual, innovation)


def test_the_order_of_the_channels_does_not_matter(rng: np.random.Generator) -> None:
    deviations, rows, innovation, weight, noise = random_problem(rng)
    order = [2, 0, 1]
    one = condition(deviations, rows @ deviations, innovation, weight, noise)
    other = condition(
        deviations, (rows @ deviations)[order], innovation[order], weight[order], noise[order]
    )
    assert_close(other.shift, one.shift, 1e-12)
    assert_close(covariance(other), covariance(one), 1e-12)
    assert_close(other.residual, one.residual[order], 1e-12)


@pytest.mark.parametrize("columns", [1, 2])
def test_noise_common_to_channels_goes_in_as_columns(
    rng: np.random.Generator, columns: int
) -> None:
    deviations, rows, innovation, _, noise = random_problem(rng)
    common = tensor(rng.standard_normal((3, columns)))
    x, z = with_columns(deviations, rows @ deviations, common)
    done = condition(x, z, innovation, torch.ones_like(noise), noise)
    full = diagonal(noise) + array(common @ common.mT)
    shift, posterior = textbook(deviations, rows, innovation, full)
    assert_close(done.shift, shift, 1e-12)
    assert_close(covariance(done), posterior, 1e-12)


@pytest.mark.parametrize("weights", [(1.0, 1.0, 1.0), (0.3, 1.0, 0.02)])
def test_a_full_noise_covariance_stands_entirely_in_columns(
    rng: np.random.Generator, weights: tuple[float, ...]
) -> None:
    deviations, rows, innovation, _, _ = random_problem(rng)
    full, weight = random_spd(rng, 3), tensor(weights)
    x, z = with_columns(deviations, rows @ deviations, tensor(np.linalg.cholesky(full)))
    done = condition(x, z, innovation, weight, (1 - weight) * tensor(np.diag(full)))
    shift, posterior = textbook(deviations, rows, innovation, weighted_noise(full, array(weight)))
    assert_close(done.shift, shift, 1e-12)
    assert_close(covariance(done), posterior, 1e-12)


def test_a_singular_prior_moves_only_in_its_range(rng: np.random.Generator) -> None:
    deviations = torch.diag(tensor([1e3, 0.0, 1e3, 0.0]))
    _, rows, innovation, weight, noise = random_problem(rng)
    done = condition(deviations, rows @ deviations, innovation, weight, noise)
    shift, posterior = textbook(deviations, rows, innovation, diagonal(noise / weight))
    assert_close(done.shift, shift, 1e-8)
    assert_close(covariance(done), posterior, 1e-8)
    assert torch.equal(done.shift[[1, 3]], torch.zeros(2, dtype=torch.float64))


@given(
    seed=st.integers(0, 10_000),
    prior=st.floats(-6, 6),
    log_noise=st.floats(-6, 6),
    dtype=st.sampled_from([torch.float32, torch.float64]),
)
def test_the_covariance_shrinks_and_stays_semidefinite_at_every_scale(
    seed: int, prior: float, log_noise: float, dtype: torch.dtype
) -> None:
    deviations, rows, innovation, weight, noise = (
        x.to(dtype) for x in random_problem(np.random.default_rng(seed))
    )
    deviations, noise = 10.0**prior * deviations, 10.0**log_noise * noise
    done = condition(deviations, rows @ deviations, innovation, weight, noise)
    before, after = (deviations @ deviations.mT).double(), covariance(done).double()
    slack = 100 * torch.finfo(dtype).eps * float(before.diagonal().max())
    assert float(torch.linalg.eigvalsh(after)[0]) >= -slack
    assert float(torch.linalg.eigvalsh(before - after)[0]) >= -slack
    assert done.shift.dtype == dtype
