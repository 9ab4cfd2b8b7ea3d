"""Derivatives of the measurement update: reverse, forward, batched, traced."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from condition_cases import random_problem, with_columns
from helpers import array, assert_close, number, tensor
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from difffilter.core.conditioning import condition
from difffilter.core.equations import sweep
from difffilter.core.sweep_gradient import ChannelSweep

CASES = ("regular", "weight 0", "masked", "all masked", "singular", "common", "full R", "batch")


def case_inputs(name: str, rng: np.random.Generator) -> tuple[Tensor, ...]:
    """Inputs of :func:`condition` for one named case."""
    batch = (2,) if name == "batch" else ()
    deviations, rows, innovation, weight, noise = random_problem(rng, batch=batch)
    if name in ("weight 0", "masked"):
        weight[1] = 0.0
    if name == "masked":
        innovation[1] = 0.0
    if name == "all masked":
        weight, innovation = 0 * weight, 0 * innovation
    if name == "singular":
        deviations = torch.diag(tensor([1e3, 0.0, 1e3, 0.0]))
    observed = rows @ deviations
    if name in ("common", "full R"):
        columns = 1 if name == "common" else 3
        common = tensor(rng.standard_normal((3, columns))) + torch.eye(3, columns)
        deviations, observed = with_columns(deviations, observed, common.double())
    if name == "full R":
        noise, weight = torch.zeros_like(noise), torch.ones_like(weight)
    return deviations, observed, innovation, weight, noise


@pytest.mark.parametrize("name", CASES)
def test_every_input_passes_gradcheck(name: str, rng: np.random.Generator) -> None:
    inputs = case_inputs(name, rng)
    # At r = 0 the square root has a one-sided derivative: that case holds r and w fixed.
    varied = inputs[:3] if name == "full R" else inputs
    for x in varied:
        x.requires_grad_()
    assert torch.autograd.gradcheck(lambda *x: tuple(condition(*x, *inputs[len(x) :])), varied)


def test_weights_under_a_full_noise_covariance_pass_gradcheck(rng: np.random.Generator) -> None:
    deviations, observed, innovation, _, _ = case_inputs("full R", rng)
    total = observed[:, 4:].square().sum(-1)
    weight = tensor([0.9, 0.0, 0.4]).requires_grad_()

    def posterior(weight: Tensor) -> tuple[Tensor, ...]:
        return tuple(condition(deviations, observed, innovation, weight, (1 - weight) * total))

    assert torch.autograd.gradcheck(posterior, weight)


def sweep_inputs(
    rng: np.random.Generator, spread: float, sigma2: float, batch: tuple[int, ...] = (6,)
) -> list[Tensor]:
    """Inputs of :func:`sweep` with 4 states, 5 channels, one of them at weight 0."""
    deviations = spread * tensor(rng.standard_normal((*batch, 4, 4)))
    observed = spread * tensor(rng.standard_normal((*batch, 5, 4)))
    innovation = spread * tensor(rng.standard_normal((*batch, 5)))
    weight = tensor(rng.uniform(0.0, 1.0, (*batch, 5)))
    weight[..., 1] = 0.0
    noise = sigma2 * tensor(rng.uniform(0.5, 2.0, (*batch, 5)))
    return [x.requires_grad_() for x in (deviations, observed, innovation, weight, noise)]


@pytest.mark.parametrize("batch", [(), (6,), (2, 3)])
@pytest.mark.parametrize(
    ("spread", "sigma2", "tolerance"),
    # The derivative towards a weight cancels as spread^2 / sigma2 grows, in autograd as here.
    [
        (1.0, 1.0, 1e-12),
        (1e3, 1e-2, 1e-9),
        (1e3, 1e-4, 1e-8),
        (1e-3, 1e2, 1e-12),
        (1.0, 1e-8, 1e-9),
    ],
)
def test_the_written_gradient_equals_autograd_of_the_equations(
    rng: np.random.Generator,
    spread: float,
    sigma2: float,
    tolerance: float,
    batch: tuple[int, ...],
) -> None:
    inputs = sweep_inputs(rng, spread, sigma2, batch)
    plain, written = sweep(*inputs)[0], ChannelSweep.apply(*inputs)
    bars = [tensor(rng.standard_normal(x.shape)) for x in plain]
    expected = torch.autograd.grad(plain, inputs, bars)
    found = torch.autograd.grad(written, inputs, bars)
    for a, b in zip(plain, written, strict=True):
        assert torch.equal(a, b)
    for a, b in zip(found, expected, strict=True):
        assert_close(a, b, tolerance)


def test_the_written_gradient_equals_autograd_where_the_noise_is_zero(
    rng: np.random.Generator,
) -> None:
    deviations, observed, innovation, weight, noise = sweep_inputs(rng, 1.0, 1.0)
    # Each channel has a noise column of its own.
    own = torch.eye(5).double().expand(6, 5, 5)
    deviations, observed = with_columns(deviations.detach(), observed.detach(), own)
    inputs = [deviations, observed, innovation, torch.ones_like(weight), 0 * noise]
    inputs = [x.detach().requires_grad_() for x in inputs]
    bars = [tensor(rng.standard_normal(x.shape)) for x in sweep(*inputs)[0]]
    expected = torch.autograd.grad(sweep(*inputs)[0], inputs, bars)
    found = torch.autograd.grad(ChannelSweep.apply(*inputs), inputs, bars)
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-10, atol=1e-12)


def test_the_gradient_does_not_write_into_what_it_was_given(rng: np.random.Generator) -> None:
    inputs = sweep_inputs(rng, 1.0, 1.0)
    outputs = ChannelSweep.apply(*inputs)
    bars = [torch.ones_like(x) for x in outputs]
    copies = [x.clone() for x in (*inputs, *bars)]
    torch.autograd.grad(outputs, inputs, bars)
    for x, copy in zip((*inputs, *bars), copies, strict=True):
        assert torch.equal(x, copy)


def test_forward_mode_equals_reverse_mode(rng: np.random.Generator) -> None:
    inputs = case_inputs("masked", rng)
    tangents = tuple(tensor(rng.standard_normal(x.shape)) for x in inputs)

    def total(*x: Tensor) -> Tensor:
        done = condition(*x)
        return done.shift.square().sum() + done.deviations.cos().sum() + done.residual.sum()

    value, along = torch.func.jvp(total, inputs, tangents)
    leaves = [x.clone().requires_grad_() for x in inputs]
    gradient = torch.autograd.grad(total(*leaves), leaves)
    expected = sum((g * t).sum() for g, t in zip(gradient, tangents, strict=True))
    assert number(along) == pytest.approx(number(expected), rel=1e-10)
    assert number(value) == pytest.approx(number(total(*inputs)), rel=1e-14)


def test_vmap_equals_the_batch(rng: np.random.Generator) -> None:
    deviations, rows, innovation, weight, noise = random_problem(rng, batch=(4,))
    inputs = (deviations, rows @ deviations, innovation, weight, noise)
    for found, expected in zip(
        torch.func.vmap(condition)(*inputs), condition(*inputs), strict=True
    ):
        assert_close(found, expected, 1e-14)


def test_torch_func_reverse_mode_equals_autograd(rng: np.random.Generator) -> None:
    inputs = case_inputs("regular", rng)

    def total(noise: Tensor) -> Tensor:
        return condition(*inputs[:4], noise).deviations.square().sum()

    leaf = inputs[4].clone().requires_grad_()
    (expected,) = torch.autograd.grad(total(leaf), leaf)
    assert_close(torch.func.grad(total)(inputs[4]), expected, 1e-12)


def test_the_update_is_traced_without_a_branch(rng: np.random.Generator) -> None:
    inputs, others = case_inputs("regular", rng), case_inputs("masked", rng)
    traced = make_fx(lambda *x: tuple(condition(*x)))(*inputs)
    for found, expected in zip(traced(*others), condition(*others), strict=True):
        assert_close(found, expected, 1e-15)


def test_a_gradient_flows_with_any_subset_of_inputs(rng: np.random.Generator) -> None:
    inputs = [x.detach() for x in case_inputs("regular", rng)]
    leaves = [x.clone().requires_grad_() for x in inputs]
    every = torch.autograd.grad(condition(*leaves).shift.sum(), leaves)
    for i in range(5):
        alone = list(inputs)
        alone[i] = inputs[i].clone().requires_grad_()
        (found,) = torch.autograd.grad(condition(*alone).shift.sum(), alone[i])
        assert_close(found, array(every[i]), 1e-13)
