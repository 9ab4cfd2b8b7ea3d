"""Consistency by direction: a mean NEES of 1 can hide errors too large one way, too small another.

The covariance of the position's states, and that of the velocity's, each have principal
directions (Jolliffe, Principal Component Analysis, sec. 2.1): along each the squared error has a
variance of its own, and their ratio is expected to be 1.
"""

from __future__ import annotations

import torch
from torch import Tensor

from difffilter.logs.log import Rows
from difffilter.logs.track import Track
from difffilter.scoring.differences import difference, known_states

__all__ = ["mean_directions", "nees_directions"]

#: Names of the directions of a block of states, by how many there are.
SIZES = {
    1: ("",),
    2: (" along the long axis", " along the short axis"),
    3: (" along the long axis", " along the middle axis", " along the short axis"),
}
#: A direction whose variance is below this share of the largest one is known exactly.
SINGULAR = 1e-14


def nees_directions(log: Rows, track: Track) -> dict[str, Tensor]:
    """(T, ...) for each principal direction of P, the longest first: (v^T e)^2 / l, 1 expected.

    v and l are an eigenvector of P and its eigenvalue, in every row anew; for the position's
    states, the velocity's, and each other true state by itself: P of all states has no
    directions of its own, since its units differ.

    NaN where a direction has no variance. The directions are taken as they are by derivatives.

    Raises:
        InputError: no truth.
    """
    found: dict[str, Tensor] = {}
    for name, states in _blocks(log, track).items():
        error = difference(log, track, states)
        deviations = track.deviations[..., track.rows(states), :]
        covariance = deviations @ deviations.mT
        known = torch.isfinite(covariance).all(-1).all(-1)[..., None, None]
        identity = torch.eye(len(states), dtype=covariance.dtype)
        covariance = torch.where(known, covariance, identity)
        vectors = _principal(covariance.detach())[1].detach()
        values = (vectors * (covariance @ vectors)).sum(-2)
        along = (vectors.mT @ error.unsqueeze(-1)).squeeze(-1).square()
        dead = values <= SINGULAR * values[..., -1:].clamp_min(1e-300)
        missing = dead | ~known[..., 0]
        ratio = torch.where(missing, torch.nan, along / torch.where(missing, 1.0, values))
        for at, size in enumerate(SIZES[len(states)]):
            found[name + size] = ratio[..., -1 - at]
    return found


def mean_directions(log: Rows, track: Track, rows: Tensor) -> dict[str, float]:
    """Means of :func:`nees_directions` over ``rows`` (T, ...); without directions of no variance.

    Raises:
        InputError: no truth.
    """
    found = {}
    for name, value in nees_directions(log, track).items():
        counted = rows & torch.isfinite(value)
        if bool(counted.any()):
            found[name] = float(value[counted].mean())
    return found


def _principal(matrix: Tensor) -> tuple[Tensor, Tensor]:
    """Eigenvalues (..., n), ascending, and eigenvectors (..., n, n) as columns.

    Two by two in closed form: many small matrices take LAPACK long.
    """
    if matrix.shape[-1] != 2:
        values, vectors = torch.linalg.eigh(matrix)
        return values, vectors
    a, b, c = matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 1, 1]
    half = 0.5 * (a - c)
    large = 0.5 * (a + c) + torch.hypot(half, b)
    small = ((a * c - b * b) / large.clamp_min(1e-300)).clamp_min(0.0)
    angle = 0.5 * torch.atan2(b, half)
    cos, sin = angle.cos(), angle.sin()
    vectors = torch.stack([torch.stack([-sin, cos], -1), torch.stack([cos, sin], -1)], -1)
    return torch.stack([small, large], -1), vectors


def _blocks(log: Rows, track: Track) -> dict[str, list[str]]:
    """States of one unit, that the truth tells and the track estimates."""
    both = [name for name in known_states(log, track) if name in track.errors]
    position = [name for name in both if track.kind(name) == "position"]
    velocity = [name for name in both if track.kind(name) == "velocity"]
    blocks = {"position": position, "velocity": velocity}
    blocks = {name: states for name, states in blocks.items() if len(states) in SIZES}
    together = [name for states in blocks.values() for name in states]
    return blocks | {name: [name] for name in both if name not in together}
