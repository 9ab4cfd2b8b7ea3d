"""Forward tangents of what a run is made of: constants and starts, towards physical values."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import torch
from torch import Tensor
from torch.autograd import forward_ad

from difffilter.core.beliefs import Belief
from difffilter.parameters.parameters import Values
from difffilter.parameters.values import Constants
from difffilter.running.batch import prepared
from difffilter.running.problem import Problem

__all__ = ["constants_and_starts", "detached", "detached_belief", "duals", "leaves_of", "tangent"]


def leaves_of(values: Values) -> dict[str, Tensor]:
    """The values that a gradient is wanted for."""
    return {n: v for n, v in values.items() if v.requires_grad and torch.is_grad_enabled()}


def duals(values: Values, leaves: Values) -> Iterator[dict[str, Tensor]]:
    """The values, each number of the leaves in its turn with a tangent of 1."""
    for name, leaf in leaves.items():
        for unit in torch.eye(leaf.numel(), dtype=leaf.dtype):
            with forward_ad.dual_level():
                dual = forward_ad.make_dual(values[name].detach(), unit.reshape(leaf.shape))  # type: ignore[no-untyped-call]
                yield {**values, name: dual}


def constants_and_starts(
    problem: Problem, values: Values, moved: bool
) -> tuple[Tensor, Tensor | None]:
    """Derivatives towards the p numbers of ``values`` that require a gradient.

    Args:
        moved: whether starts depend on the values.

    Returns:
        Of the packed constants (p, C), and of each trajectory's packed start (p, ..., S), or
        None.
    """
    found, starts = [], []
    for given in duals(detached(values), leaves_of(values)):
        if moved:
            constants, current, _ = prepared(
                problem.recipe, problem.log, given, problem.start, problem.temperature
            )
            lead = current.mean.shape[:-1]
            parts = [tangent(x).reshape(*lead, -1) for x in tensors(current)]
            starts.append(torch.cat(parts, -1))
        else:
            constants = problem.recipe.prepare(given, problem.temperature)
        found.append(torch.cat([tangent(c).reshape(-1) for c in constants.values()]))
    return torch.stack(found), torch.stack(starts) if moved else None


def tangent(x: Tensor) -> Tensor:
    """The tangent of a dual number; 0 of any other."""
    found: Tensor | None = forward_ad.unpack_dual(x).tangent  # type: ignore[no-untyped-call]
    return torch.zeros_like(x) if found is None else found


def tensors(belief: Belief) -> list[Tensor]:
    """What a belief is packed from, in order."""
    return [belief.mean, belief.deviations, *belief.memory.values()]


def detached(values: Mapping[str, Tensor] | Constants) -> dict[str, Tensor]:
    """The same numbers without gradient."""
    return {name: value.detach() for name, value in values.items()}


def detached_belief(belief: Belief) -> Belief:
    """The same belief without gradient."""
    return Belief(belief.mean.detach(), belief.deviations.detach(), detached(belief.memory))
