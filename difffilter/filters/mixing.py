"""How several modes switch, exchange estimates and are told as one."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Record
from difffilter.core.jacobian import jacobian_times
from difffilter.core.linalg import positive_sqrt, product, semidefinite_cholesky
from difffilter.motions.protocol import Motion
from difffilter.motions.retraction import moved
from difffilter.parameters.values import Constants

__all__ = [
    "Estimate", "Switched", "estimate_of", "exchanged", "joined", "joint_record", "kept", "least",
    "normalised", "own_constants", "own_estimate", "switched",
]  # fmt: skip

#: Gauss-Newton steps to the mean of estimates on a manifold: each squares the distance left.
STEPS = 4


class Estimate(NamedTuple):
    """Of one mode, or of all.

    Attributes:
        mean: (..., n).
        half: (..., p (p + 1) / 2), the lower half of the covariance, row by row.
        memory: of the mode's filter.
    """

    mean: Tensor
    half: Tensor
    memory: Mapping[str, Tensor] = {}

    @property
    def covariance(self) -> Tensor:
        """(..., p, p)."""
        size = math.isqrt(2 * self.half.shape[-1])
        whole = self.half[..., _halves(size)[2]]
        return whole.reshape(*whole.shape[:-1], size, size)


def estimate_of(belief: Belief) -> Estimate:
    """The same with a covariance in place of its factor."""
    factor = belief.deviations
    return Estimate(belief.mean, _half(product(factor, factor.mT)), belief.memory)


class Switched(NamedTuple):
    """Where the modes come from, (..., K) each.

    Attributes:
        predicted: c_j, the probability of each mode before the row.
        stays: share of c_j in which the mode was j already and was not drawn anew.
        fresh: the rest, in which it was drawn anew, from whatever it was: 1 - stays.
    """

    predicted: Tensor
    stays: Tensor
    fresh: Tensor


def least(like: Tensor) -> float:
    """Least probability: what it may sink to and still come back."""
    return torch.finfo(like.dtype).tiny


def normalised(predicted: Tensor, logarithm: Tensor) -> Tensor:
    """Shares (..., K) of c_j exp(l_j), whatever the size of l; no c_j is 0."""
    parts = predicted * (logarithm - logarithm.amax(-1, keepdim=True)).exp()
    return parts / parts.sum(-1, keepdim=True)


def switched(known: Tensor, constants: Constants, dt: Tensor) -> Switched:
    """c_j = sum_i mu_i P_ij(dt) = kept mu_j + (1 - kept) share_j, and its two parts' shares."""
    share = constants["modes.share"]
    kept = (-constants["modes.rate"] * dt).exp().unsqueeze(-1)
    drawn = ((1.0 - kept) * share).clamp_min(least(share)) * known.sum(-1, keepdim=True)
    stays = kept * known
    predicted = stays + drawn
    inverse = predicted.reciprocal()
    return Switched(predicted, stays * inverse, drawn * inverse)


def exchanged(
    motion: Motion, stays: Tensor, fresh: Tensor, of_all: Estimate, own: Estimate
) -> Estimate:
    """What a mode starts from: its own estimate if it stays, that of all if it is drawn anew.

    The moments of sum_i mu_i P_ij / c_j of the estimates: P_ij is a multiple of mu-free share_j
    but for i = j, so that two parts are all there is, whatever the number of modes::

        m = m_all + stays d,    P = fresh P_all + stays P_j + stays fresh d d^T,    d = m_j - m_all
    """
    shift, half = _carried(motion, of_all.mean, own)
    moves = stays.unsqueeze(-1) * shift
    spread = fresh.unsqueeze(-1) * of_all.half + stays.unsqueeze(-1) * half
    spread = spread + _outer(fresh.unsqueeze(-1) * moves, shift)
    if motion.flat:
        return Estimate(of_all.mean + moves, spread, own.memory)
    factor = semidefinite_cholesky(Estimate(shift, spread).covariance)
    there = Belief(*moved(motion, of_all.mean, moves, factor), own.memory)
    return estimate_of(there)


def joined(motion: Motion, weights: Tensor, estimates: Sequence[Estimate]) -> Belief:
    """Mean and deviations with the moments of a mixture of estimates with weights (..., K).

    P = sum_i w_i (P_i + d_i d_i^T): a sum of semidefinite matrices, whose large parts do not
    cancel. On a manifold d_i = local(m, m_i) and P_i is carried to the tangent space at m, the
    mean for which sum_i w_i d_i = 0, found by Gauss-Newton from the likeliest mode.
    """
    each = weights.unbind(-1)
    mean = _centre(motion, each, [estimate.mean for estimate in estimates])
    parts = []
    for w, estimate in zip(each, estimates, strict=True):
        shift, half = _carried(motion, mean, estimate)
        parts.append(w.unsqueeze(-1) * (half + _outer(shift, shift)))
    whole = Estimate(mean, sum(parts[1:], parts[0])).covariance
    return Belief(mean, semidefinite_cholesky(whole))


def _centre(motion: Motion, weights: Sequence[Tensor], means: Sequence[Tensor]) -> Tensor:
    """The mean of means (..., n), by their differences: equal ones stay what they are."""
    first, *others = means
    if motion.flat:
        more = (w.unsqueeze(-1) * (m - first) for w, m in zip(weights[1:], others, strict=True))
        return sum(more, first)
    centre, most = first, weights[0]
    for w, m in zip(weights[1:], others, strict=True):
        centre = torch.where((w > most).unsqueeze(-1), m, centre)
        most = torch.maximum(most, w)
    for _ in range(STEPS if others else 0):
        shifts = [
            w.unsqueeze(-1) * motion.local(centre, m) for w, m in zip(weights, means, strict=True)
        ]
        centre = motion.retract(centre, sum(shifts[1:], shifts[0]))
    return centre


def _carried(motion: Motion, at: Tensor, estimate: Estimate) -> tuple[Tensor, Tensor]:
    """Shift (..., p) from ``at`` to an estimate; half its covariance in the tangent space there."""
    mean = estimate.mean
    if motion.flat:
        return mean - at, estimate.half

    def there(shift: Tensor) -> Tensor:
        return motion.local(at, motion.retract(mean, shift))

    covariance = estimate.covariance
    none = torch.zeros_like(covariance[..., 0])
    once = jacobian_times(there, none, covariance)
    return motion.local(at, mean), _half(jacobian_times(there, none, once.mT))


def own_constants(mode: str, constants: Constants) -> Constants:
    """Those that a mixture has named for a mode when it prepared."""
    found = {
        name[len(mode) + 1 :]: constant
        for name, constant in constants.items()
        if name.startswith(f"{mode}/")
    }
    return Constants(found)


def kept(mode: str, estimate: Estimate) -> dict[str, Tensor]:
    """A mode's estimate as memory of the mixture."""
    named = {"mean": estimate.mean, "half": estimate.half, **estimate.memory}
    return {f"{mode}/{name}": value for name, value in named.items()}


def own_estimate(mode: str, memory: Mapping[str, Tensor]) -> Estimate:
    """A mode's estimate out of the memory of the mixture."""
    own = {
        name[len(mode) + 1 :]: value
        for name, value in memory.items()
        if name.startswith(f"{mode}/")
    }
    return Estimate(own.pop("mean"), own.pop("half"), own)


def _half(whole: Tensor) -> Tensor:
    """The lower half of (..., p, p), row by row."""
    rows, columns, _ = _halves(whole.shape[-1])
    return whole[..., rows, columns]


def _outer(a: Tensor, b: Tensor) -> Tensor:
    """The lower half of a b^T."""
    rows, columns, _ = _halves(a.shape[-1])
    return a[..., rows] * b[..., columns]


@cache
def _halves(size: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rows and columns of a lower half, and where each entry of the whole stands in it."""
    rows, columns = torch.tril_indices(size, size)
    place = torch.zeros(size, size, dtype=torch.long)
    place[rows, columns] = torch.arange(len(rows))
    place[columns, rows] = torch.arange(len(rows))
    return rows, columns, place.flatten()


def joint_record(predicted: Tensor, probability: Tensor, records: Sequence[Record]) -> Record:
    """Of the mixture: nominal moments by the predicted probabilities, weights by the final ones."""
    if len(records) == 1:
        return records[0]._replace(modes=probability)

    def mean(weights: Tensor, parts: Sequence[Tensor]) -> Tensor:
        return (torch.stack([*parts], dim=-1) * weights.unsqueeze(-2)).sum(-1)

    first = records[0]
    innovation = mean(predicted, [record.innovation for record in records])
    return Record(
        innovation=innovation,
        observed=_spread(predicted, innovation, records),
        noise=mean(predicted, [record.noise for record in records]),
        standardised=mean(probability, [record.standardised for record in records]),
        weight=mean(probability, [record.weight for record in records]),
        prior_weight=mean(probability, [record.prior_weight for record in records]),
        gate=mean(probability, [record.gate for record in records]),
        modes=probability,
        present=first.present,
        isolated=first.isolated,
    )


def _spread(predicted: Tensor, innovation: Tensor, records: Sequence[Record]) -> Tensor:
    """Columns of the predicted measurement's covariance over all modes: as few as there can be."""
    each = predicted.unbind(-1)
    shifts = [record.innovation - innovation for record in records]
    m, k = records[0].observed.shape[-2:]
    if m <= len(records) * (k + 1):
        parts = [
            p[..., None, None]
            * (
                product(record.observed, record.observed.mT)
                + shift.unsqueeze(-1) * shift.unsqueeze(-2)
            )
            for p, record, shift in zip(each, records, shifts, strict=True)
        ]
        return semidefinite_cholesky(sum(parts[1:], parts[0]))
    columns = []
    for p, record, shift in zip(each, records, shifts, strict=True):
        root = positive_sqrt(p)[..., None, None]
        columns += [root * record.observed, root * shift.unsqueeze(-1)]
    return torch.cat(columns, dim=-1)
