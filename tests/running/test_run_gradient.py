"""Gradients of twenty steps towards every parameter, against finite differences."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from helpers import tensor
from run_cases import FILTERS, SHIFTED, airport_log, make, tdoa, with_offset
from torch import Tensor
from torch.autograd import gradcheck

from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.weights.registry import imq, tanh

LOG = airport_log(20, 2, missing=0.2, seed=11)
SHORT = airport_log(8, 2, missing=0.2, seed=11)
SOFT = 0.4

#: Smooth where the hard form has no kink at all, or none near the data's residuals.
HARD = {
    "ekf": FILTERS["ekf"],
    "imq": FILTERS["imq"],
    "m-ekf": FILTERS["m-ekf"],
    "all rows": FILTERS["all rows"],
    "mad": FILTERS["mad"],
    "igg3": FILTERS["igg3"],
    "full R": FILTERS["full R"],
    "common noise": FILTERS["common noise"],
    "common noise m-ekf": make(tdoa(common_sigma=2.0), weight=tanh, iterations=2),
    "bias per channel": FILTERS["bias per channel"],
    "gate": FILTERS["gate"],
    "adaptive": FILTERS["adaptive"],
}
GATES = ("gate", "gate reweigh", "gate inflate")
SOFTENED = {
    name: FILTERS[name] for name in ("m-ekf", "all rows", "mad", "igg3", "full R", *GATES)
} | {"imq of huber's": make(weight=imq, gate=FILTERS["gate"].gate)}


def folded(filter: Filter, log: Log, values: Values, temperature: float | None) -> Tensor:
    """Everything that a loss reads, each of the order of one."""
    track = run(filter, log, values, temperature=temperature)
    record = track.record
    assert record is not None
    assert log.truth is not None
    parts = [
        track.mean - log.truth.nan_to_num(),
        track.covariance.diagonal(dim1=-2, dim2=-1),
        record.innovation / 10.0,
        record.innovation_variance.log(),
        record.weight,
        record.nis,
    ]
    return torch.cat([part.flatten() for part in parts])


def projections(count: int) -> Tensor:
    """Three fixed random sums over all outputs: a Jacobian of three rows checks them all."""
    generator = torch.Generator().manual_seed(5)
    return torch.randn(3, count, generator=generator, dtype=torch.float64) / count**0.5


def check(filter: Filter, log: Log, temperature: float | None) -> None:
    """Gradient towards all parameters, in unconstrained numbers, and towards every z."""
    declared = filter.declarations
    free = [p.constraint.free(p.tensor()).requires_grad_() for p in declared.values()]
    rows = projections(folded(filter, log, filter.published(), temperature).numel())

    def function(*raw: Tensor) -> Tensor:
        values = {
            name: p.constraint.physical(tensor)
            for (name, p), tensor in zip(declared.items(), raw, strict=True)
        }
        return rows @ folded(filter, log, values, temperature)

    fast = filter.iterations > 0 or filter is FILTERS["full R"]  # random directions, or each entry
    gradcheck(function, free, eps=1e-6, atol=2e-6, rtol=2e-5, fast_mode=fast)
    total = function(*free).square().sum()
    gradients = torch.autograd.grad(total, free, allow_unused=True)
    for name, gradient in zip(declared, gradients, strict=True):
        if name not in NO_EFFECT:
            assert gradient is not None
            assert bool(gradient.any()), f"{name} has no gradient"


#: Of a hard gate: no derivative away from the threshold. Bounds that no window reached.
NO_EFFECT = {"gate.threshold", "adaptive.bounds_q", "adaptive.bounds_r"}


@pytest.mark.parametrize("name", HARD)
def test_the_hard_form_passes_gradcheck(name: str) -> None:
    check(HARD[name], LOG, None)


@pytest.mark.parametrize("name", SOFTENED)
def test_the_soft_form_passes_gradcheck(name: str) -> None:
    check(SOFTENED[name], LOG, SOFT)


def test_a_run_with_inputs_passes_gradcheck() -> None:
    check(SHIFTED, with_offset(SHORT), SOFT)


@pytest.mark.parametrize("name", GATES)
def test_a_soft_gates_threshold_has_a_gradient(name: str) -> None:
    threshold = tensor(7.9).requires_grad_()
    track = run(FILTERS[name], LOG, {"gate.threshold": threshold}, temperature=1.0)
    (gradient,) = torch.autograd.grad(track.mean.square().mean(), threshold)
    assert float(gradient) != 0.0


@pytest.mark.parametrize("name", ["m-ekf", "gate", "mad"])
@pytest.mark.parametrize("temperature", [None, SOFT])
def test_the_gradient_towards_start_and_measurements_passes_gradcheck(
    name: str, temperature: float | None
) -> None:
    filter, log = FILTERS[name], SHORT
    assert log.start is not None
    present = log.present
    rows = projections(folded(filter, log, filter.published(), temperature).numel())

    def function(mean: Tensor, seen: Tensor) -> Tensor:
        z = torch.full_like(log.z, torch.nan).masked_scatter(present, seen)
        given = replace(log, z=z, start=Start(mean, None, 0.0))
        return rows @ folded(filter, given, filter.published(), temperature)

    inputs = (log.start.mean.clone().requires_grad_(), log.z[present].requires_grad_())
    gradcheck(function, inputs, eps=1e-5, atol=2e-6, rtol=2e-5, fast_mode=True)


def test_the_gradient_of_one_trajectory_does_not_depend_on_its_batch() -> None:
    filter = FILTERS["m-ekf"]

    def gradient(log: Log) -> Tensor:
        sigma = tensor(3.0).requires_grad_()
        track = run(filter, log, {"tdoa.sigma": sigma})
        return torch.autograd.grad(track.mean.square().sum(), sigma)[0]

    parts = [gradient(LOG.select([i])) for i in range(2)]
    torch.testing.assert_close(gradient(LOG), parts[0] + parts[1], rtol=1e-10, atol=0.0)


def test_a_wholly_missing_log_gives_a_finite_gradient() -> None:
    log = replace(LOG, z=torch.full_like(LOG.z, torch.nan))
    for name in ("m-ekf", "mad", "gate", "common noise", "full R"):
        filter = FILTERS[name]
        values = {k: v.requires_grad_() for k, v in filter.published().items()}
        track = run(filter, log, values, temperature=SOFT)
        loss = track.mean.square().mean() + track.deviations.square().mean()
        gradients = torch.autograd.grad(loss, list(values.values()), allow_unused=True)
        assert all(g is None or bool(g.isfinite().all()) for g in gradients)
        moved = dict(zip(values, gradients, strict=True))["motion.acceleration"]
        assert moved is not None
        assert bool(moved.all())
