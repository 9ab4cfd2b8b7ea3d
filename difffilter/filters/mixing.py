"""How several modes switch, exchange estimates and are told as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Record
from difffilter.core.linalg import positive_sqrt, product, semidefinite_cholesky
from difffilter.parameters.values import Constants

__all__ = [
    "Moments", "joint_record", "kept", "least", "merged", "mixed", "moments", "normalised",
    "own_belief",
]  # fmt: skip


class Moments(NamedTuple):
    """Of K beliefs: what every merge of them is a weighted sum of.

    Attributes:
        beliefs: themselves.
        covariances: P_i, each (..., n, n).
        apart: (m_i - m_j)(m_i - m_j)^T of every two, i < j.
    """

    beliefs: Sequence[Belief]
    covariances: Sequence[Tensor]
    apart: Mapping[tuple[int, int], Tensor]


def moments(beliefs: Sequence[Belief]) -> Moments:
    """What the merges of these beliefs share; computed once for all of them."""
    covariances = [product(b.deviations, b.deviations.mT) for b in beliefs]
    apart = {}
    for i, j in combinations(range(len(beliefs)), 2):
        shift = beliefs[i].mean - beliefs[j].mean
        apart[i, j] = shift.unsqueeze(-1) * shift.unsqueeze(-2)
    return Moments(beliefs, covariances, apart)


def merged(weights: Tensor, of: Moments) -> Belief:
    """Mean and deviations with the moments of a mixture of beliefs with weights (..., K).

    m = sum_i w_i m_i and P = sum_i w_i P_i + sum_{i<j} w_i w_j (m_i - m_j)(m_i - m_j)^T, the same
    as sum_i w_i (P_i + (m_i - m)(m_i - m)^T) for weights that sum to 1: a sum of semidefinite
    matrices, whose large parts do not cancel.
    """
    if len(of.beliefs) == 1:
        return of.beliefs[0]
    each = weights.unbind(-1)
    first, *more = (w.unsqueeze(-1) * b.mean for w, b in zip(each, of.beliefs, strict=True))
    parts = [w[..., None, None] * p for w, p in zip(each, of.covariances, strict=True)]
    parts += [(each[i] * each[j])[..., None, None] * d for (i, j), d in of.apart.items()]
    return Belief(sum(more, first), semidefinite_cholesky(sum(parts[1:], parts[0])))


def least(like: Tensor) -> float:
    """Least probability: what it may sink to and still come back."""
    return torch.finfo(like.dtype).tiny


def normalised(logarithm: Tensor) -> Tensor:
    """Shares (..., K) of the exponentials; whatever their size."""
    parts = (logarithm - logarithm.amax(-1, keepdim=True)).exp()
    return parts / parts.sum(-1, keepdim=True)


def mixed(known: Tensor, constants: Constants, dt: Tensor) -> tuple[Tensor, Tensor]:
    """c_j = sum_i mu_i P_ij(dt), (..., K), and the weights mu_i P_ij / c_j, (..., K, K).

    P_ij = kept [i = j] + (1 - kept) share_j: with that, c_j = kept mu_j + (1 - kept) share_j.
    """
    share = constants["modes.share"]
    kept = (-constants["modes.rate"] * dt).exp().unsqueeze(-1)
    drawn = ((1.0 - kept) * share).clamp_min(least(share))
    stays = kept * known
    predicted = stays + drawn * known.sum(-1, keepdim=True)
    unit = torch.eye(len(share), dtype=share.dtype, device=share.device)
    # The share of c_j that came anew, of every mode as it was likely; the rest is mode j itself.
    anew = known.unsqueeze(-1) * (drawn / predicted).unsqueeze(-2)
    return predicted, anew + unit * (stays / predicted).unsqueeze(-2)


def kept(mode: str, belief: Belief) -> dict[str, Tensor]:
    """A mode's belief as memory of the mixture."""
    named = {"mean": belief.mean, "deviations": belief.deviations, **belief.memory}
    return {f"{mode}/{name}": value for name, value in named.items()}


def own_belief(mode: str, memory: Mapping[str, Tensor]) -> Belief:
    """A mode's belief out of the memory of the mixture."""
    own = {
        name[len(mode) + 1 :]: value
        for name, value in memory.items()
        if name.startswith(f"{mode}/")
    }
    return Belief(own.pop("mean"), own.pop("deviations"), own)


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
        observed=_spread(predicted, records),
        noise=mean(predicted, [record.noise for record in records]),
        standardised=mean(probability, [record.standardised for record in records]),
        weight=mean(probability, [record.weight for record in records]),
        prior_weight=mean(probability, [record.prior_weight for record in records]),
        gate=mean(probability, [record.gate for record in records]),
        modes=probability,
        present=first.present,
        isolated=first.isolated,
    )


def _spread(predicted: Tensor, records: Sequence[Record]) -> Tensor:
    """Columns of the predicted measurement's covariance over all modes: as few as there can be."""
    each = predicted.unbind(-1)
    m, k = records[0].observed.shape[-2:]
    if m <= len(records) * (k + 1):
        of = moments([Belief(record.innovation, record.observed) for record in records])
        return merged(predicted, of).deviations
    innovation = sum(
        (p.unsqueeze(-1) * r.innovation for p, r in zip(each[1:], records[1:], strict=True)),
        each[0].unsqueeze(-1) * records[0].innovation,
    )
    columns = []
    for p, record in zip(each, records, strict=True):
        root = positive_sqrt(p)[..., None, None]
        apart = (innovation - record.innovation).unsqueeze(-1)
        columns += [root * record.observed, root * apart]
    return torch.cat(columns, dim=-1)
