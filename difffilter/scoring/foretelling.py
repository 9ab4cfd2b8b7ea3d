"""How well measurements were foretold: scores, consistency, whiteness of innovations. No truth."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Record

__all__ = ["BEYOND", "Foretold", "correlation", "surprise"]

#: Sigmas beyond which one in twenty normal innovations lies.
BEYOND = 1.959964


def surprise(innovation: Tensor, variance: Tensor, degrees: float = 4.0) -> Tensor:
    """Negative log density of each innovation, Student's t of scale sqrt(variance): in nats."""
    nu = degrees
    constant = math.lgamma((nu + 1.0) / 2.0) - math.lgamma(nu / 2.0) - 0.5 * math.log(nu * math.pi)
    ratio = innovation.square() / (nu * variance)
    return 0.5 * variance.log() + 0.5 * (nu + 1.0) * ratio.log1p() - constant


class Foretold(NamedTuple):
    """Measurements beside what was foretold of them.

    Attributes:
        innovation, variance: (T, B, m), measured minus foretold, and the variance that was
            claimed for it.
        present: (T, B, m), which were asked for.
    """

    innovation: Tensor
    variance: Tensor
    present: Tensor

    @classmethod
    def of(cls, record: Record, parts: int = 1) -> Foretold:
        """Of a record; with ``parts`` variants of the same trajectories, each hiding others."""
        fields = record.innovation, record.innovation_variance, record.present
        split = [x.reshape(len(x), parts, -1, x.shape[-1]) for x in fields]
        asked = split[2].to(split[0].dtype)
        present = split[2].any(1)
        variance = torch.where(present, (asked * split[1]).sum(1), 1.0)
        return cls((asked * split[0]).sum(1), variance, present)

    @property
    def standardised(self) -> Tensor:
        """(T, B, m), innovations in sigmas; 0 where nothing was asked."""
        return torch.where(self.present, self.innovation * self.variance.rsqrt(), 0.0)

    def score(self, degrees: float = 4.0) -> Tensor:
        """(T, B, m), surprise of each measurement in nats; 0 where nothing was asked."""
        found = surprise(self.innovation, self.variance, degrees)
        return torch.where(self.present, found, 0.0)

    def squares(self) -> float:
        """Mean square in sigmas: 1 where innovations are as large as claimed."""
        return float(self.standardised.square().sum() / self.present.sum())

    def beyond(self) -> float:
        """Share beyond 1.96 sigmas: 0.05 of normal ones."""
        far = (self.standardised.abs() > BEYOND).sum()
        return float(far / self.present.sum())

    def only(self, channel: int) -> Foretold:
        """Of one channel."""
        return Foretold(*(x[..., channel : channel + 1] for x in self))


def correlation(told: Foretold) -> float:
    """Of a channel's successive innovations in sigmas, those between missing ones left out.

    0 within 2 / sqrt(count) where they are white; above where errors last.
    """
    found, present = told.standardised.flatten(1), told.present.flatten(1)
    products = pairs = 0.0
    for one, seen in zip(found.mT, present.mT, strict=True):
        kept = one[seen]
        products += float((kept[1:] * kept[:-1]).sum())
        pairs += float(kept.square().sum())
    return products / pairs if pairs > 0.0 else float("nan")
