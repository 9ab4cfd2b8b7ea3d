"""Third-degree spherical-radial cubature in square-root form (Arasaratnam and Haykin 2009)."""

from __future__ import annotations

import math

import torch
from torch import Tensor

__all__ = ["doubled", "halves", "moments", "points", "square"]


def points(mean: Tensor, deviations: Tensor) -> Tensor:
    """m + sqrt(n) X_j, then m - sqrt(n) X_j: (2n, ..., n), from X (..., n, n)."""
    n = mean.shape[-1]
    spread = n**0.5 * deviations.movedim(-1, 0)
    return torch.cat([mean + spread, mean - spread])


def moments(values: Tensor) -> tuple[Tensor, Tensor]:
    """Mean (..., m) and deviations (..., m, 2n) of values at the points (2n, ..., m)."""
    mean = values.mean(0)
    deviations = (values - mean) / len(values) ** 0.5
    return mean, deviations.movedim(0, -1)


def square(columns: Tensor, n: int) -> Tensor:
    """X (..., n, n) that :func:`doubled` columns stand for; n columns are given back."""
    return columns if columns.shape[-1] == n else columns[..., :n] * 2.0**0.5


def halves(columns: Tensor, n: int) -> Tensor:
    """The n columns, in the basis of X, that 2n cubature columns stand for: (..., m, n).

    Linear parts stand in both halves with opposite sign. Exact for a linear function; its
    statistical linearisation otherwise. n columns are given back as they are.
    """
    if columns.shape[-1] == n:
        return columns
    difference = columns[..., :n] - columns[..., n : 2 * n]
    return difference / math.sqrt(2.0)


def doubled(columns: Tensor) -> Tensor:
    """[X, -X] / sqrt(2): the 2n cubature columns (..., m, 2n) of a linear part X (..., m, n)."""
    return torch.cat([columns, -columns], dim=-1) * math.sqrt(0.5)
