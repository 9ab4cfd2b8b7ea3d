"""What links each row of a run to the next one, so that a smoother can go back."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement
from difffilter.core.cubature import doubled
from difffilter.core.jacobian import jacobian_times
from difffilter.core.linalg import semidefinite_cholesky
from difffilter.core.smooth import Backward, backward
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.mixture import Mixture
from difffilter.filters.prediction import predict
from difffilter.filters.stepping import step
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.motions.protocol import Motion
from difffilter.motions.retraction import moved
from difffilter.parameters.values import Constants

__all__ = ["Estimates", "Links", "adapted", "check_smoothable", "link", "links", "step_back"]

#: Mean (..., n) and deviations (..., p, p).
Estimates = tuple[Tensor, Tensor]
#: By how many units of rounding a predicted covariance may miss what its parts add up to.
ROUNDING = 1e4


class Links(NamedTuple):
    """From each row but the last to the next one.

    Attributes:
        predicted: (T - 1, ..., n), means before the measurement, adapted ones.
        back: gains and remaining deviations (T - 1, ...).
    """

    predicted: Tensor
    back: Backward


def check_smoothable(recipe: object) -> Filter:
    """The filter; InputError where its rows are not linked by one Gaussian model."""
    found = ""
    if isinstance(recipe, Mixture):
        found = "a mixture, whose modes mix at every row"
    elif not isinstance(recipe, Filter):
        raise InputError(f"smooth: found {type(recipe).__name__}, expected a filter")
    elif getattr(recipe.adaptation, "rescales", False):
        found = "an adaptation that scales each state's past by a number of its own"
    if found:
        raise InputError(f"smooth: found {found}, expected one filter without it")
    assert isinstance(recipe, Filter)
    return recipe


def adapted(filter: Filter) -> bool:
    """Whether the covariance before a measurement may be other than the motion's."""
    inflates = filter.recovery is not None and filter.recovery.action == "inflate"
    return filter.adaptation is not None or filter.weigh_prior or inflates


def links(
    filter: Filter, constants: Constants, log: Log, track: Track, first: Belief, intervals: Tensor
) -> Links:
    """All rows' predictions and gains at once.

    An adaptation or recovery is run over the log once more, for its memory.

    Args:
        track: the filter's of that log, from the belief ``first``, dt ``intervals`` (T, ...).
    """
    at = Belief(track.mean[:-1], track.deviations[:-1])
    inputs = {name: value[1:] for name, value in log.inputs.items()}
    lead = (..., *[None] * (log.z.dim() - 2 - (intervals.dim() - 1)))
    dt = intervals[1:][lead].expand(log.z.shape[:-1][0] - 1, *log.z.shape[1:-1])
    row = Measurement(log.z[1:], dt, inputs)
    if not adapted(filter):
        return link(filter, constants, at, row)
    if filter.adaptation is not None or filter.recovery is not None:
        at = at._replace(memory=_memories(filter, constants, log, first, intervals))
    weight = None if track.record is None else track.record.prior_weight[1:]
    return link(filter, constants, at, row, weight)


def _memories(
    filter: Filter, constants: Constants, log: Log, first: Belief, intervals: Tensor
) -> dict[str, Tensor]:
    """(T - 1, ...), what the filter carries after each row but the last."""
    now, found = first, []
    for t in range(log.steps - 1):
        inputs = {name: value[t] for name, value in log.inputs.items()}
        now, _ = step(filter, constants, now, Measurement(log.z[t], intervals[t], inputs))
        found.append(now.memory)
    return {name: torch.stack([memory[name] for memory in found]) for name in first.memory}


def link(
    filter: Filter,
    constants: Constants,
    at: Belief,
    row: Measurement,
    prior_weight: Tensor | None = None,
) -> Links:
    """What links beliefs to the rows after them.

    An inflated covariance P' is what a larger process noise would have made of the same past:
    P' - F P F^T - Q counts as more of it, and so does a prior that was weighed down.

    Raises:
        InputError: a covariance that an adaptation made smaller than the motion does.
    """
    process, p = None, at.deviations.shape[-1]
    if adapted(filter):
        linear = filter.prior(constants, at, row).linear
        mean, ahead = linear.mean, linear.moved
        factor = linear.factor[..., :p, :]
        if filter.weigh_prior and prior_weight is not None:
            factor = factor * prior_weight.rsqrt().unsqueeze(-2)
        process = torch.cat([linear.process, _extra(factor, ahead, linear.process)], dim=-1)
    else:
        step = predict(filter, constants, at, row)
        mean, ahead, process = step.mean, step.moved, step.process
    filtered = at.deviations if ahead.shape[-1] == p else doubled(at.deviations)
    return Links(mean, backward(filtered, ahead, process))


def _extra(factor: Tensor, ahead: Tensor, process: Tensor) -> Tensor:
    """Deviations (..., p, p) of what the covariance exceeds its parts by."""
    whole = factor @ factor.mT
    extra = whole - ahead @ ahead.mT - process @ process.mT
    size = whole.diagonal(dim1=-2, dim2=-1).sqrt()
    scale = size.unsqueeze(-1) * size.unsqueeze(-2)
    least = ROUNDING * torch.finfo(whole.dtype).eps
    nothing = (extra.abs() <= least * scale).all(-1).all(-1)
    extra = torch.where(nothing[..., None, None], 0.0, extra)
    unit = torch.where(scale > 0.0, scale, 1.0)
    if bool((torch.linalg.eigvalsh((extra / unit).detach())[..., 0] < -least).any()):
        raise InputError(
            "smooth: found an adaptation that makes the predicted covariance smaller than the "
            "motion does, expected one that inflates it or leaves it"
        )
    return semidefinite_cholesky(extra)


def step_back(
    motion: Motion, filtered: Tensor, predicted: Tensor, back: Backward, later: Estimates
) -> Estimates:
    """This row's smoothed mean and deviations from the next row's.

    On a manifold the next estimate is carried to the tangent space at the prediction, and this
    one from that at the filtered mean to its own, by the derivatives of ``local``.
    """
    mean, deviations = later
    if motion.flat:
        return back.mean(filtered, mean - predicted), back.deviations(deviations)

    def there(shift: Tensor) -> Tensor:
        return motion.local(predicted, motion.retract(mean, shift))

    none = torch.zeros_like(deviations[..., 0])
    deviations = jacobian_times(there, none, deviations)
    shift = back.mean(none, motion.local(predicted, mean))
    return moved(motion, filtered, shift, back.deviations(deviations))
