"""The loss that tuning minimises, as a function of values: by either engine."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.autograd import forward_ad

from difffilter.core.beliefs import Belief
from difffilter.engine.choice import eager_seconds, with_engine
from difffilter.errors import NonFiniteError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.parameters.parameters import Values
from difffilter.running.batch import prepared, run
from difffilter.scoring.losses import LOSSES, LossContext, check_losses, weighted, with_scenes

__all__ = ["Sums", "objective", "sum_losses"]


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


def sum_losses(
    filter: Filter,
    log: Log,
    values: Values,
    start: Start | Belief | None,
    losses: Mapping[str, float],
    context: LossContext,
    temperature: float | None = None,
    engine: str = "fused",
) -> Sums:
    """The sums with forward tangents towards what requires a gradient.

    With the fused engine memory does not grow with the length of the log: nothing is kept
    per step. With torch, one run for each tangent.

    Raises:
        EngineError: the step cannot be compiled; InputError: as for :func:`run` and
        :func:`total_loss`; NonFiniteError: names trajectory, step and state.
    """
    check_losses(losses, log)
    leaves = {n: v for n, v in values.items() if v.requires_grad and torch.is_grad_enabled()}
    plain = {name: value.detach() for name, value in values.items()}
    if engine == "torch":
        found = _torch_sums(filter, log, plain, leaves, start, tuple(losses), context, temperature)
    else:
        found = _fused_sums(filter, log, values, leaves, start, tuple(losses), context, temperature)
    if leaves:
        total = _Sums.apply(found.tangents, found.values, *leaves.values())  # type: ignore[no-untyped-call]
        found = found._replace(values=total)
    return found


def _fused_sums(
    filter: Filter,
    log: Log,
    values: Values,
    leaves: Values,
    start: Start | Belief | None,
    names: tuple[str, ...],
    context: LossContext,
    temperature: float | None,
) -> Sums:
    from difffilter.engine.fused import Job, sums
    from difffilter.engine.trace import Objective

    rows = with_scenes(log, context)
    constants, current, intervals = prepared(filter, log, values, start, temperature)
    job = Job(filter, _detached(constants), rows, _detached_belief(current), intervals)
    wanted = Objective(names, context, log.truth_states)
    tangents = None
    if leaves:
        moved = any(x.requires_grad for x in _tensors(current))
        tangents = _tangents(filter, log, values, start, temperature, constants, moved)
    counts, total, dtotal, gram, bad = sums(job, wanted, tangents)
    if bool((bad >= 0).any()):
        _locate(job, log, values, start, temperature, bad)
    return Sums(total, dict(zip(names, counts, strict=True)), dtotal, gram)


def _torch_sums(
    filter: Filter,
    log: Log,
    values: Values,
    leaves: Values,
    start: Start | Belief | None,
    names: tuple[str, ...],
    context: LossContext,
    temperature: float | None,
) -> Sums:
    """One run for the sums, or one for each tangent, in forward mode."""
    rows = with_scenes(log, context)

    def once(given: Values) -> tuple[list[Tensor], Tensor]:
        track = run(filter, log, given, start, temperature=temperature, engine="torch")
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
        parts, _ = once(values)
        total, sizes = summed(parts), {n: x.shape[-1] for n, x in zip(names, parts, strict=True)}
        tangents, moved = [], []
        for given in _duals(values, leaves):
            parts, residuals = once(given)
            tangents.append(summed([_tangent(x) for x in parts]))
            moved.append(_tangent(residuals))
    p = len(tangents)
    if not p:
        size = log.trajectories
        return Sums(
            total, sizes, total.new_zeros(size, 0, total.shape[-1]), total.new_zeros(size, 0, 0)
        )
    jacobian = torch.stack(moved, -1)
    gram = torch.einsum("tbep,tbeq->bpq", jacobian, jacobian)
    return Sums(total, sizes, torch.stack(tangents, 1), gram)


def _duals(values: Values, leaves: Values) -> Iterator[dict[str, Tensor]]:
    """The values, each number of the leaves in its turn with a tangent of 1."""
    for name, leaf in leaves.items():
        for unit in torch.eye(leaf.numel(), dtype=leaf.dtype):
            with forward_ad.dual_level():
                dual = forward_ad.make_dual(values[name].detach(), unit.reshape(leaf.shape))  # type: ignore[no-untyped-call]
                yield {**values, name: dual}


def objective(
    filter: Filter,
    log: Log,
    values: Values,
    start: Start | Belief | None = None,
    *,
    losses: Mapping[str, float],
    context: LossContext | None = None,
    temperature: float | None = None,
    engine: str = "auto",
    reduce: Callable[[Tensor], Tensor] | None = None,
) -> tuple[Tensor, dict[str, Tensor]]:
    """Weighted sum of losses of a run, and each term: differentiable towards ``values``.

    Args:
        filter, log, values, start, temperature: as for :func:`difffilter.run`.
        losses: weight of each by name; context: what they need.
        engine: ``torch`` differentiates backwards through the run; ``fused`` carries the
            tangents beside the state; ``auto`` as for :func:`difffilter.run`.
        reduce: of the sums over trajectories, where others run elsewhere.

    Raises:
        InputError, NonFiniteError: as for :func:`difffilter.run`, and for a loss that is
            unknown or needs truth.
    """
    context = context or LossContext()
    check_losses(losses, log)

    def fused() -> tuple[Tensor, list[int]]:
        sums = sum_losses(filter, log, values, start, losses, context, temperature)
        return sums.values.sum(0), list(sums.sizes.values())

    def plain() -> tuple[Tensor, list[int]]:
        track = run(filter, log, values, start, temperature=temperature, engine="torch")
        rows = with_scenes(log, context)
        parts = [LOSSES[name].rows(track, rows, context).flatten(0, -2).sum(0) for name in losses]
        return torch.cat(parts), [len(part) for part in parts]

    total, sizes = with_engine(engine, fused, plain, 4.0 * eager_seconds(log, filter.iterations))
    split = torch.split(total if reduce is None else reduce(total), sizes)
    terms = {name: LOSSES[name].value(part) for name, part in zip(losses, split, strict=True)}
    return weighted(losses, terms), terms


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


def _tangents(
    filter: Filter,
    log: Log,
    values: Values,
    start: Start | Belief | None,
    temperature: float | None,
    constants: Values,
    moved: bool,
) -> Any:
    """Derivatives of constants (and of starts, where they ``moved``) towards the values."""
    from difffilter.engine.fused import Tangents

    leaves = {name: v for name, v in values.items() if v.requires_grad}
    active = frozenset(name for name, c in constants.items() if c.requires_grad)
    found, starts = [], []
    for given in _duals(_detached(values), leaves):
        if moved:
            prepare, current, _ = prepared(filter, log, given, start, temperature)
            lead = current.mean.shape[:-1]
            parts = [_tangent(x).reshape(*lead, -1) for x in _tensors(current)]
            starts.append(torch.cat(parts, -1))
        else:
            prepare = filter.prepare(given, temperature)
        found.append(torch.cat([_tangent(c).reshape(-1) for c in prepare.values()]))
    return Tangents(torch.stack(found), active, torch.stack(starts) if moved else None)


def _tangent(x: Tensor) -> Tensor:
    tangent: Tensor | None = forward_ad.unpack_dual(x).tangent  # type: ignore[no-untyped-call]
    return torch.zeros_like(x) if tangent is None else tangent


def _tensors(belief: Belief) -> list[Tensor]:
    return [belief.mean, belief.deviations, *belief.memory.values()]


def _detached(values: Values) -> dict[str, Tensor]:
    return {name: value.detach() for name, value in values.items()}


def _detached_belief(belief: Belief) -> Belief:
    return Belief(belief.mean.detach(), belief.deviations.detach(), _detached(belief.memory))


def _locate(
    job: Any,
    log: Log,
    values: Values,
    start: Start | Belief | None,
    temperature: float | None,
    bad: Tensor,
) -> None:
    """Raise the error that names trajectory, step and state or channel."""
    with torch.no_grad():
        run(job.filter, log, _detached(values), start, temperature=temperature, engine="fused")
    where = int((bad >= 0).nonzero()[0])
    raise NonFiniteError("mean", where, int(bad[where]), job.filter.states[0])
