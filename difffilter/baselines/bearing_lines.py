"""Batch least squares on all bearings so far (paper 1's comparison), for a known velocity."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from tqdm import tqdm

from difffilter.baselines.least_squares import Snapshot, check_channels
from difffilter.core.linalg import semidefinite_cholesky
from difffilter.errors import InputError
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.sensors.sensor import wrap
from difffilter.start.bearings import Lines, crossing, lines, the_bearing
from difffilter.start.rows import flatten

__all__ = ["BearingLeastSquares"]


@dataclass(frozen=True)
class BearingLeastSquares(Snapshot):
    """Position from all bearings up to each row, for a target of known, constant velocity.

    * pseudo-linear (paper 1): minimise the sum of (a_k (p + v tau_k - s_k))^2; linear, but a
      bearing counts with the square of its distance, and its noise is in a_k as well;
    * ``weighted``: minimise the sum of squared bearing residuals, by Gauss-Newton from the
      estimate of the row before: the maximum likelihood of a target that does not accelerate.

    Attributes:
        velocity: m/s, in the frame of the state.
        weighted: see above; iterations: of Gauss-Newton, per row.
    """

    velocity: tuple[float, ...] = (0.0, 0.0)
    weighted: bool = False
    iterations: int = 3

    def __post_init__(self) -> None:
        the_bearing(self.sensors)
        if len(self.velocity) != self.axes:
            raise InputError(f"velocity: found {len(self.velocity)}, expected {self.axes} numbers")

    def estimate(
        self,
        log: Log,
        values: Values | None = None,
        start: Start | None = None,
        progress: bool = False,
    ) -> Track:
        """Track over the log; NaN while the lines do not cross. ``start`` is not used.

        Raises:
            InputError: other channels, a value that does not fit.
        """
        check_channels(log, self.channels)
        if not log.steps:
            raise InputError("log: found no row, expected one or more")
        sensor = the_bearing(self.sensors)
        constants = self.prepare(self.published(log.z.dtype) | dict(values or {}))
        flat = flatten(log)
        velocity = flat.z.new_tensor(self.velocity)
        since = flat.time - flat.time[:1]
        found = lines(sensor, flat, constants, velocity, since)
        variance = constants[f"{sensor.name}.total"]
        position = _pseudo_linear(found)
        if self.weighted:
            position = _gauss_newton(found, position, self.iterations, progress)
        covariance = _covariance(found, position, variance, self.weighted)
        known = torch.isfinite(covariance).all(-1).all(-1)[..., None, None]
        deviations = semidefinite_cholesky(torch.where(known, covariance, 0.0))
        deviations = torch.where(known, deviations, torch.nan)
        moved = position + since.unsqueeze(-1) * velocity
        shape = log.z.shape[:-1]
        return Track(
            self.states,
            self.channels,
            log.time,
            moved.reshape(*shape, 2),
            deviations.reshape(*shape, 2, 2),
        )


def _pseudo_linear(found: Lines) -> Tensor:
    """(T, B, 2), position at the first row's time, from all lines so far."""
    normal, right = _sums(found, torch.ones_like(found.normal[..., 0]))
    return crossing(normal.cumsum(0), right.cumsum(0))


def _sums(found: Lines, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Each row's normal matrix (T, B, 2, 2) and right side (T, B, 2)."""
    scaled = found.normal * weight.unsqueeze(-1)
    outer = scaled.unsqueeze(-1) * found.normal.unsqueeze(-2)
    right = scaled * (found.normal * found.origin).sum(-1, keepdim=True)
    return outer.sum(2), right.sum(2)


def _gauss_newton(found: Lines, start: Tensor, iterations: int, progress: bool) -> Tensor:
    """(T, B, 2), minimum of the squared bearing residuals up to each row."""
    current, made = start[0], []
    for k in tqdm(range(len(start)), desc="bearings", delay=2.0, disable=not progress):
        current = torch.where(torch.isnan(current), start[k], current)
        so_far = Lines(*(part[: k + 1] for part in found))
        for _ in range(iterations):
            jacobian, residual = _bearing(so_far, current)
            normal = (jacobian.unsqueeze(-1) * jacobian.unsqueeze(-2)).sum((0, 2))
            right = (jacobian * residual.unsqueeze(-1)).sum((0, 2))
            current = current + crossing(normal, right)
        made.append(current)
    return torch.stack(made)


def _bearing(found: Lines, position: Tensor) -> tuple[Tensor, Tensor]:
    """Gradient (T, B, m, 2) and residual (T, B, m) of each bearing, 0 where missing."""
    x, y = (position.unsqueeze(-2) - found.origin).unbind(-1)
    square = x.square() + y.square()
    jacobian = torch.stack([-y, x], dim=-1) / square.unsqueeze(-1)
    residual = wrap(torch.nan_to_num(found.bearing), torch.atan2(y, x))
    return jacobian * found.present.unsqueeze(-1), residual * found.present


def _covariance(found: Lines, position: Tensor, variance: Tensor, weighted: bool) -> Tensor:
    """(T, B, 2, 2), of the fit at each row for independent bearing noise."""
    made = []
    for k in range(len(position)):
        so_far = Lines(*(part[: k + 1] for part in found))
        if weighted:
            jacobian, _ = _bearing(so_far, position[k])
            scaled = jacobian / variance.unsqueeze(-1)
            information = (scaled.unsqueeze(-1) * jacobian.unsqueeze(-2)).sum((0, 2))
            made.append(_inverse(information))
            continue
        # The sandwich: each equation's variance is the bearing's times the squared distance.
        offset = (position[k].unsqueeze(-2) - so_far.origin).square().sum(-1)
        normal, _ = _sums(so_far, torch.ones_like(offset))
        spread, _ = _sums(so_far, offset * variance)
        bread = _inverse(normal.sum(0))
        made.append(bread @ spread.sum(0) @ bread)
    return torch.stack(made)


def _inverse(matrix: Tensor) -> Tensor:
    """Inverse (..., 2, 2), NaN where singular."""
    unit = torch.eye(2, dtype=matrix.dtype, device=matrix.device)
    columns = [crossing(matrix, unit[i].expand_as(matrix[..., i])) for i in range(2)]
    return torch.stack(columns, dim=-1)
