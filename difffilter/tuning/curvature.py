"""Gradient and curvature of a tuning loss in unconstrained numbers, from forward tangents."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.parameters.parameters import ParameterSet
from difffilter.running.objectives import Sums
from difffilter.scoring.losses import LOSSES
from difffilter.tuning.processes import Ranks

__all__ = ["Expansion", "chain_rule", "expand", "known"]


def known(weights: Mapping[str, float]) -> bool:
    """Whether Gauss-Newton knows the curvature: of one loss of squares, and smooth ones."""
    losses = [LOSSES[name] for name in weights]
    squares = [loss.residuals is not None for loss in losses]
    return sum(squares) == 1 and all(
        loss.curved or own for loss, own in zip(losses, squares, strict=True)
    )


class Expansion(NamedTuple):
    """A loss to second order around the current values.

    Attributes:
        loss: the weighted sum, the prior included.
        terms: each loss before weighting.
        gradient: (p,), towards the unconstrained numbers.
        curvature: (p, p), Gauss-Newton's, positive semidefinite.
        spread: (p, p), sum over trajectories of s s^T, s being what each adds to the gradient
            (through S and through J), less their mean.
    """

    loss: float
    terms: dict[str, Tensor]
    gradient: Tensor
    curvature: Tensor
    spread: Tensor


def expand(
    weights: Mapping[str, float],
    sums: Sums,
    parameters: ParameterSet,
    share: float,
    among: Ranks | None = None,
    inputs: Mapping[str, Tensor] | None = None,
) -> Expansion:
    """Expand the loss of the current values.

    With S the sums of a loss f(S), J = dS/du and G = J^T J of the residuals that the first
    sum squares, its curvature is J^T f'' J without the negative part of f'', and
    2 df/dS_1 G [generalised Gauss-Newton].

    Args:
        weights: of each loss; sums: with tangents towards the physical values.
        share: weight of the prior.
        among: the processes that hold the other trajectories.
        inputs: of the log, for losses that weigh trajectories apart.
    """
    among = among or Ranks()
    chain = chain_rule(parameters)
    tangents = torch.einsum("bpq,pu->buq", sums.tangents, chain)
    grams = chain.mT @ sums.gram @ chain
    total, moved = among.add(sums.values.detach().sum(0)), among.add(tangents.sum(0))
    p = chain.shape[-1]
    scores, curvature = total.new_zeros(len(sums.values), p), total.new_zeros(p, p)
    gradient = total.new_zeros(p)
    loss, terms, at = 0.0, {}, 0
    for name, size in sums.sizes.items():
        here = slice(at, at := at + size)
        value = LOSSES[name].value
        part = total[here].clone().requires_grad_()
        term = value(part)
        (slope,) = torch.autograd.grad(term, part)
        bend: Tensor = torch.autograd.functional.hessian(value, total[here])  # type: ignore[no-untyped-call]
        jacobian, weight = moved[..., here], weights[name]
        gradient = gradient + weight * (jacobian @ slope)
        own = sums.values.detach()[:, here]
        scores = scores + weight * (tangents[..., here] @ slope + own @ bend @ jacobian.mT)
        curvature = curvature + weight * jacobian @ _positive(bend) @ jacobian.mT
        if LOSSES[name].residuals is not None:
            slopes = LOSSES[name].slopes
            rise = slope[:1] if slopes is None else slopes(slope, inputs or {})
            gram = among.add((rise[:, None, None] * grams).sum(0))
            curvature = curvature + 2.0 * weight * gram
        loss, terms[name] = loss + weight * float(term.detach()), term.detach()
    prior, slope, bend = _prior(parameters, share)
    count = float(among.add(torch.tensor(float(len(scores)), dtype=torch.float64)))
    summed = among.add(scores.sum(0))
    spread = among.add(scores.mT @ scores) - torch.outer(summed, summed) / count
    return Expansion(loss + prior, terms, gradient + slope, curvature + torch.diag(bend), spread)


def chain_rule(parameters: ParameterSet) -> Tensor:
    """(physical numbers, unconstrained numbers): derivatives of the constraints' maps."""
    blocks = []
    for name, raw in parameters.free().items():
        physical = parameters.declarations[name].constraint.physical
        block: Tensor = torch.autograd.functional.jacobian(physical, raw.detach())  # type: ignore[no-untyped-call]
        blocks.append(block.reshape(-1, raw.numel()))
    chain: Tensor = torch.block_diag(*blocks)  # type: ignore[no-untyped-call]
    return chain


def _positive(matrix: Tensor) -> Tensor:
    """The positive semidefinite part of a symmetric matrix."""
    values, vectors = torch.linalg.eigh(matrix)
    positive: Tensor = vectors @ torch.diag(values.clamp_min(0.0)) @ vectors.mT
    return positive


def _prior(parameters: ParameterSet, share: float) -> tuple[float, Tensor, Tensor]:
    """Value, gradient and curvature of the parameters' priors, times ``share``."""
    free = list(parameters.free().values())
    value = parameters.negative_log_prior()
    if not value.requires_grad:
        zero = torch.zeros(sum(x.numel() for x in free), dtype=value.dtype)
        return 0.0, zero, zero
    slopes = torch.autograd.grad(value, free, allow_unused=True)
    flat = [torch.zeros_like(x) if g is None else g for x, g in zip(free, slopes, strict=True)]
    priors = [parameters.declarations[name].prior for name in parameters.free()]
    bends = [
        torch.full_like(x, 0.0 if prior is None else 1.0 / prior**2)
        for x, prior in zip(free, priors, strict=True)
    ]
    slope, bend = (torch.cat([x.reshape(-1) for x in part]) for part in (flat, bends))
    return share * float(value.detach()), share * slope, share * bend
