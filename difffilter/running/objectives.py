"""The loss that tuning minimises, as a function of values: by either engine.

The chain rule, and who computes which factor. A loss f(S) is a function of sums S over the
rows of a run; the run depends on constants c (what ``recipe.prepare`` makes once per run), these
on the physical values theta, and these on the unconstrained numbers u that an optimiser moves:

    dL/du = df/dS . dS/dc . dc/dtheta . dtheta/du

- df/dS: autograd, of the few sums (``Loss.value``), here and in ``tuning/curvature``.
- dS/dc: with the fused engine, tangents that the compiled step carries beside the state
  (``engine/derivative``); with torch, autograd backwards through the loop, or one run for
  each tangent where sums per trajectory are wanted.
- dc/dtheta: forward tangents of ``prepare`` and of the start (``running/tangents``); the
  fused engine is given dc/dtheta and brings back dS/dtheta.
- dtheta/du: the constraints' maps, by autograd: in ``ParameterSet.values()``, or as a matrix
  in ``tuning/curvature.chain_rule``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from difffilter.engine.choice import eager_seconds, with_engine
from difffilter.errors import NonFiniteError
from difffilter.filters.hiding import Hiding
from difffilter.filters.recipe import Recipe
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.parameters.values import Constants
from difffilter.running.batch import prepared, run
from difffilter.running.interpolation import interpolated
from difffilter.running.problem import Problem
from difffilter.running.tangents import (
    constants_and_starts,
    detached,
    detached_belief,
    duals,
    leaves_of,
    tangent,
    tensors,
)
from difffilter.scoring.losses import LOSSES, check_losses, weighted, with_scenes

__all__ = ["Problem", "Sums", "asks_smoother", "objective", "sum_losses"]


class Sums(NamedTuple):
    """Sums of the losses' rows per trajectory, and derivatives towards tuned values.

    Attributes:
        values: (B, q), differentiable towards the values that require a gradient.
        sizes: how many of the q belong to each loss.
        tangents: (B, p, q), towards every number that requires a gradient, in order.
        gram: (B, p, p), J^T J of the position residuals; 0 without such a loss.
    """

    values: Tensor
    sizes: Mapping[str, int]
    tangents: Tensor
    gram: Tensor


def sum_losses(problem: Problem, values: Values) -> Sums:
    """The sums with forward tangents towards what requires a gradient.

    With the fused engine memory does not grow with the length of the log: nothing is kept
    per step. With ``engine = "torch"``, one run for each tangent.

    Raises:
        EngineError: the step cannot be compiled; InputError: as for :func:`run` and
        :func:`total_loss`; NonFiniteError: names trajectory, step and state.
    """
    check_losses(problem.losses, problem.log)
    leaves = leaves_of(values)
    eager = problem.engine == "torch" or asks_smoother(problem.recipe)
    summed = _torch_sums if eager else _fused_sums
    found = summed(problem, values)
    if leaves:
        total = _Sums.apply(found.tangents, found.values, *leaves.values())  # type: ignore[no-untyped-call]
        found = found._replace(values=total)
    return found


def _fused_sums(problem: Problem, values: Values) -> Sums:
    from difffilter.engine.fused import Job, Tangents, sums
    from difffilter.engine.trace import Objective

    log, names = problem.log, tuple(problem.losses)
    rows = with_scenes(log, problem.context)
    constants, current, intervals = prepared(
        problem.recipe, log, values, problem.start, problem.temperature
    )
    job = Job(
        problem.recipe, Constants(detached(constants)), rows, detached_belief(current), intervals
    )
    tangents = None
    if leaves_of(values):
        moved = any(x.requires_grad for x in tensors(current))
        towards, starts = constants_and_starts(problem, values, moved)
        active = frozenset(name for name, c in constants.items() if c.requires_grad)
        tangents = Tangents(towards, active, starts)
    wanted = Objective(names, problem.context, log.truth_states)
    counts, total, dtotal, gram, bad = sums(job, wanted, tangents)
    if bool((bad >= 0).any()):
        _locate(problem, values, bad)
    return Sums(total, dict(zip(names, counts, strict=True)), dtotal, gram)


def _torch_sums(problem: Problem, values: Values) -> Sums:
    """One run for the sums, or one for each tangent, in forward mode."""
    log, names, context = problem.log, tuple(problem.losses), problem.context
    plain, leaves, rows = detached(values), leaves_of(values), with_scenes(log, context)

    def once(given: Values) -> tuple[list[Tensor], Tensor]:
        track = _track(problem, given)
        parts = [LOSSES[name].rows(track, rows, context) for name in names]
        residuals = [
            loss.residuals(track, rows, context).reshape(log.steps, log.trajectories, -1)
            for loss in (LOSSES[name] for name in names)
            if loss.residuals is not None
        ]
        empty = log.z.new_zeros(log.steps, log.trajectories, 0)
        return parts, torch.cat([empty, *residuals], -1)

    def summed(parts: list[Tensor]) -> Tensor:
        return torch.cat([x.reshape(log.steps, log.trajectories, -1).sum(0) for x in parts], -1)

    with torch.no_grad():
        parts, _ = once(plain)
        total, sizes = summed(parts), {n: x.shape[-1] for n, x in zip(names, parts, strict=True)}
        tangents, moved = [], []
        for given in duals(plain, leaves):
            parts, residuals = once(given)
            tangents.append(summed([tangent(x) for x in parts]))
            moved.append(tangent(residuals))
    if not tangents:
        none = total.new_zeros(log.trajectories, 0, total.shape[-1])
        return Sums(total, sizes, none, total.new_zeros(log.trajectories, 0, 0))
    jacobian = torch.stack(moved, -1)
    gram = torch.einsum("tbep,tbeq->bpq", jacobian, jacobian)
    return Sums(total, sizes, torch.stack(tangents, 1), gram)


def objective(
    problem: Problem, values: Values, reduce: Callable[[Tensor], Tensor] | None = None
) -> tuple[Tensor, dict[str, Tensor]]:
    """Weighted sum of losses of a run, and each term: differentiable towards ``values``.

    Args:
        problem: recipe, log, start, losses, engine.
        values: physical parameter values by name; the published ones where missing.
        reduce: of the sums over trajectories, where others run elsewhere.

    Raises:
        InputError, NonFiniteError: as for :func:`difffilter.run`, and for a loss that is
            unknown or needs truth.
    """
    log, losses = problem.log, problem.losses
    check_losses(losses, log)

    def fused() -> tuple[Tensor, list[int]]:
        sums = sum_losses(replace(problem, engine="fused"), values)
        return sums.values.sum(0), list(sums.sizes.values())

    def plain() -> tuple[Tensor, list[int]]:
        track = _track(problem, values)
        rows = with_scenes(log, problem.context)
        parts = [
            LOSSES[name].rows(track, rows, problem.context).flatten(0, -2).sum(0)
            for name in losses
        ]  # fmt: skip
        return torch.cat(parts), [len(part) for part in parts]

    seconds = 4.0 * eager_seconds(log)
    engine = "torch" if asks_smoother(problem.recipe) else problem.engine
    total, sizes = with_engine(engine, fused, plain, seconds)
    split = torch.split(total if reduce is None else reduce(total), sizes)
    terms = {name: LOSSES[name].value(part) for name, part in zip(losses, split, strict=True)}
    return weighted(losses, terms), terms


def asks_smoother(recipe: Recipe) -> bool:
    """Whether the loss is of what the smoother foretells: no engine but torch sums that."""
    return isinstance(recipe, Hiding) and recipe.smoothed


def _track(problem: Problem, values: Values) -> Track:
    """The run whose record the losses read, by torch."""
    recipe, log, start = problem.recipe, problem.log, problem.start
    settings: dict[str, Any] = {"temperature": problem.temperature, "engine": "torch"}
    if isinstance(recipe, Hiding) and recipe.smoothed:
        return interpolated(recipe.recipe, log, values, start, **settings)
    return run(recipe, log, values, start, **settings)


class _Sums(torch.autograd.Function):
    """Sums whose derivative is known already."""

    @staticmethod
    def forward(ctx: Any, tangents: Tensor, total: Tensor, *leaves: Tensor) -> Tensor:
        ctx.save_for_backward(tangents)
        ctx.shapes = [leaf.shape for leaf in leaves]
        return total.clone()

    @staticmethod
    def backward(ctx: Any, bar: Tensor) -> tuple[Tensor | None, ...]:
        (tangents,) = ctx.saved_tensors
        flat = (tangents * bar.unsqueeze(1)).sum((0, 2))
        parts = flat.split([shape.numel() for shape in ctx.shapes])
        return None, None, *(p.reshape(s) for p, s in zip(parts, ctx.shapes, strict=True))


def _locate(problem: Problem, values: Values, bad: Tensor) -> None:
    """Raise the error that names trajectory, step and state or channel."""
    with torch.no_grad():
        run(
            problem.recipe, problem.log, detached(values), problem.start,
            temperature=problem.temperature, engine="fused",
        )  # fmt: skip
    where = int((bad >= 0).nonzero()[0])
    raise NonFiniteError("mean", where, int(bad[where]), problem.recipe.states[0])
