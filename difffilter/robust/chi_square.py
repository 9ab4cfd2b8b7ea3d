"""Quantiles of the chi-square distribution, differentiable in the threshold."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["equivalent_thresholds", "log_survival"]


def log_survival(x: Tensor, degrees: int) -> Tensor:
    """log P(chi-square with ``degrees`` of freedom > x), finite far into the tail.

    From Q(a + 1, y) = Q(a, y) + y^a e^-y / Gamma(a + 1) with y = x / 2, upwards from
    Q(1/2, y) = erfc(sqrt y) or Q(1, y) = e^-y: a sum of positive terms.
    """
    y = 0.5 * x
    a = 0.5 * (degrees % 2 or 2)
    first = -y if a == 1.0 else math.log(2.0) + torch.special.log_ndtr(-x.sqrt())
    terms = [first]
    while a < 0.5 * degrees:
        terms.append(a * y.log() - y - math.lgamma(a + 1.0))
        a += 1.0
    return torch.logsumexp(torch.stack(terms), dim=0)


def equivalent_thresholds(threshold: Tensor, most: int) -> Tensor:
    """Thresholds of the same significance for 1 to ``most`` degrees of freedom: (most,).

    Newton's method on the logarithm of the survival function, which is concave from two
    degrees on: from any start it approaches from the right. One more step with gradient gives
    the implicit-function derivative towards the threshold (of one degree of freedom).
    """
    target = log_survival(threshold, 1)

    def newton(x: Tensor, wanted: Tensor, degrees: int) -> Tensor:
        half = 0.5 * degrees
        log_density = (half - 1.0) * x.log() - 0.5 * x - half * math.log(2.0) - math.lgamma(half)
        value = log_survival(x, degrees)
        return x + (value - wanted) / (log_density - value).exp()

    found = [threshold]
    for degrees in range(2, most + 1):
        with torch.no_grad():
            x = threshold.detach() + degrees
            for _ in range(30):
                x = newton(x, target.detach(), degrees)
        found.append(newton(x, target, degrees))
    return torch.stack(found)
