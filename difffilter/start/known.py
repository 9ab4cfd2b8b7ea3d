"""Starts that are known: given by hand, or the truth that a log has."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from difffilter.core.beliefs import belief
from difffilter.errors import InputError
from difffilter.logs.log import Log, Start

__all__ = ["at_position", "from_truth"]


def at_position(
    states: Sequence[str],
    position: Sequence[float],
    velocity: Sequence[float] | None = None,
    covariance: Sequence[float] | Sequence[Sequence[float]] | None = None,
    time: float | None = None,
    dtype: torch.dtype = torch.float64,
) -> Start:
    """Start from a position and, by the names of the states, a velocity; the rest is 0.

    Args:
        states: names, the position's first, its velocities ``v`` + name.
        position, velocity: m and m/s; velocity 0 if missing.
        covariance: n variances or n x n, of all states (or of more: the first n count); None
            for the filter's ``start.sigma``.
        time: s; None for the first row's.

    Raises:
        InputError: numbers that do not fit, a covariance that is none.
    """
    n, axes = len(states), len(position)
    if axes > n:
        raise InputError(f"start.position: found {axes} numbers, expected {n} or fewer")
    mean = torch.zeros(n, dtype=dtype)
    mean[:axes] = torch.tensor(list(position), dtype=dtype)
    moving = list(velocity) if velocity is not None else [0.0] * axes
    if len(moving) != axes:
        raise InputError(f"start.velocity: found {len(moving)} numbers, expected {axes}")
    for name, speed in zip(states[:axes], moving, strict=True):
        if f"v{name}" in states:
            mean[list(states).index(f"v{name}")] = speed
    if covariance is None:
        return Start(mean, None, time)
    matrix = torch.tensor(covariance, dtype=dtype)
    matrix = torch.diag(matrix) if matrix.dim() == 1 else matrix
    if matrix.dim() != 2 or matrix.shape[0] != matrix.shape[1] or len(matrix) < n:
        raise InputError(
            f"start.covariance: found shape {list(matrix.shape)}, "
            f"expected {n} variances or {n} x {n} ({', '.join(states)})"
        )
    matrix = matrix[:n, :n]
    belief(mean, matrix)
    return Start(mean, matrix, time)


def from_truth(
    states: Sequence[str],
    log: Log,
    position_sigma: float = 0.0,
    velocity_sigma: float = 0.0,
    span: float = 2.0,
) -> Start:
    """Start of every trajectory at its log's truth in the first row.

    Velocities that the truth lacks are the slope of its positions over ``span`` seconds (the
    least-squares line); other states are 0.

    Args:
        states: names.
        log: with truth, z (T, m) or (T, B, m).
        position_sigma, velocity_sigma: m and m/s, of the start's covariance (other states
            0); None, the filter's ``start.sigma``, where both are 0.

    Raises:
        InputError: no truth, none of the positions in it, or none in the first row.
    """
    if log.truth is None:
        raise InputError("start: found a log without truth, expected columns truth_<state>")
    known = list(log.truth_states)
    if states[0] not in known:
        raise InputError(
            f"start: found truth of {', '.join(known)}, expected {states[0]} among them"
        )
    lead = log.z.shape[1:-1]
    mean = log.truth.new_zeros(*lead, len(states))
    variance = mean.new_zeros(len(states))
    for i, name in enumerate(states):
        if name in known:
            mean[..., i] = log.truth[0, ..., known.index(name)]
        elif name[:1] == "v" and name[1:] in known:
            mean[..., i] = _slope(log.time, log.truth[..., known.index(name[1:])], span)
        if name[:1] == "v" and name[1:] in states:
            variance[i] = velocity_sigma**2
        elif f"v{name}" in states or name in "xyz":
            variance[i] = position_sigma**2
    missing = torch.isnan(mean).any(-1).reshape(-1)
    if bool(missing.any()):
        at = int(missing.nonzero()[0])
        name = log.names[at] if log.names and log.names[at] else str(at)
        raise InputError(f"start: trajectory {name}: found no truth in its first row")
    if not (position_sigma or velocity_sigma):
        return Start(mean)
    return Start(mean, torch.diag(variance).expand(*lead, -1, -1))


def _slope(time: Tensor, position: Tensor, span: float) -> Tensor:
    """Slope (...) of positions (T, ...) over the first ``span`` seconds; 0 for a single row."""
    time = time.reshape(*time.shape, *[1] * (position.dim() - time.dim())).expand_as(position)
    since = time - time[:1]
    used = torch.isfinite(position) & (since <= span)
    count = used.sum(0).clamp_min(1)
    middle = torch.where(used, since, 0.0).sum(0) / count
    apart = torch.where(used, since - middle, 0.0)
    square = apart.square().sum(0)
    slope = (apart * torch.where(used, position, 0.0)).sum(0)
    return torch.where(square > 0.0, slope / torch.where(square > 0.0, square, 1.0), 0.0)
