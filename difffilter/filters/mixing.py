"""How several modes switch, exchange estimates and are told as one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Record
from difffilter.core.compression import compress
from difffilter.core.linalg import positive_sqrt
from difffilter.parameters.values import Constants

__all__ = ["joint_record", "kept", "merged", "normalised", "own_belief", "switching"]


def merged(weights: Tensor, beliefs: Sequence[Belief]) -> Belief:
    """Mean and deviations with the moments of a mixture of beliefs with weights (..., K).

    m = sum w_i m_i and P = sum w_i (P_i + (m_i - m)(m_i - m)^T), as columns: semidefinite by
    construction.
    """
    if len(beliefs) == 1:
        return beliefs[0]
    each = weights.unbind(-1)
    mean = sum((w.unsqueeze(-1) * b.mean for w, b in zip(each, beliefs, strict=True)), 0.0)
    assert isinstance(mean, Tensor)
    columns = []
    for w, b in zip(each, beliefs, strict=True):
        root = positive_sqrt(w)[..., None, None]
        columns += [root * b.deviations, root * (b.mean - mean).unsqueeze(-1)]
    return Belief(mean, compress(*columns))


def normalised(logarithm: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    """log sum exp along a dimension, kept, and the shares of it."""
    largest = logarithm.amax(dim, keepdim=True)
    parts = (logarithm - largest).exp()
    total = parts.sum(dim, keepdim=True)
    return largest + total.log(), parts / total


def switching(constants: Constants, dt: Tensor) -> Tensor:
    """log P_ij(dt), (..., K, K)."""
    share = constants["modes.share"]
    kept = (-constants["modes.rate"] * dt)[..., None, None].exp()
    unit = torch.eye(len(share), dtype=share.dtype, device=share.device)
    return (kept * unit + (1.0 - kept) * share).clamp_min(torch.finfo(share.dtype).tiny).log()


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
    columns = []
    for root, record in zip(positive_sqrt(predicted).unbind(-1), records, strict=True):
        root = root[..., None, None]
        apart = (innovation - record.innovation).unsqueeze(-1)
        columns += [root * record.observed, root * apart]
    return Record(
        innovation=innovation,
        observed=torch.cat(columns, dim=-1),
        noise=mean(predicted, [record.noise for record in records]),
        standardised=mean(probability, [record.standardised for record in records]),
        weight=mean(probability, [record.weight for record in records]),
        prior_weight=mean(probability, [record.prior_weight for record in records]),
        gate=mean(probability, [record.gate for record in records]),
        modes=probability,
        present=first.present,
        isolated=first.isolated,
    )
