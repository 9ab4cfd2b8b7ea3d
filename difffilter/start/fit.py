"""Damped, iterated, weighted least squares for a position."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.linalg import positive_sqrt
from difffilter.parameters.values import Constants
from difffilter.sensors.information import Information, covariance_factor, stacked_noise
from difffilter.sensors.sensor import Sensor

__all__ = ["Fix", "Frame", "Weigh", "gauss_newton", "linearised", "residual"]

Inputs = Mapping[str, Tensor]
Weigh = Callable[[Tensor], Tensor]

FIRST_DAMPING = 1e-3
DAMPING_FACTOR = 10.0


class Frame(NamedTuple):
    """How the unknowns make the states: x = offset + along unknown.

    Attributes:
        along: (n, a), or (E, ..., n, a) where it differs by row (a position that moves).
        offset: (n,) or (E, ..., n), states that are known.
        information: (a,), prior information 1 / sigma^2 that each unknown is 0.
    """

    along: Tensor
    offset: Tensor
    information: Tensor

    def state(self, unknown: Tensor) -> Tensor:
        """(..., a) -> (..., n)."""
        return self.offset + (self.along * unknown.unsqueeze(-2)).sum(-1)


class Fix(NamedTuple):
    """A position and the deviations of its error; NaN where the data do not determine it.

    Attributes:
        position: (..., axes), m.
        deviations: (..., axes, axes), m; covariance = deviations deviations^T.
    """

    position: Tensor
    deviations: Tensor


def gauss_newton(
    sensors: Sequence[Sensor],
    constants: Constants,
    z: Tensor,
    inputs: Inputs,
    start: Tensor,
    weigh: Weigh | None = None,
    iterations: int = 20,
    *,
    epochs: bool = False,
    frame: Frame | None = None,
) -> Fix:
    """Least squares of measurements towards a position, over any leading dimensions.

    With H the gradient of h at p, e = z - h(p) and M = diag(sqrt w) R^-1 diag(sqrt w)::

        p <- p + (H^T M H + damping I)^-1 H^T M e

    (Taylor-series least squares, paper 3; the damping is Levenberg's [reconstruction]). A
    step that does not lower e^T M e, with M of the point before, is refused and the damping
    raised; else the damping falls, so that the last steps are Gauss-Newton's. For weights
    that fall with the residual, as Cauchy's, each step then lowers the robust cost too.

    Args:
        sensors, constants: models and their constants, channels in the order of ``z``.
        z: (..., m), NaN where missing; with ``epochs`` (E, ..., m), all of one position.
        inputs: known inputs, with the leading dimensions of ``z``.
        start: (..., axes), m; its leading dimensions broadcast with those of ``z``.
        weigh: weights (..., m) in [0, 1] from residuals in sigmas (..., m); None for 1.
        iterations: fixed number of steps.
        epochs: whether the first dimension of ``z`` is summed over.
        frame: how the unknowns make the state that the sensors read; None: they are it.

    Returns:
        The position and (H^T M H)^-1 there as deviations; NaN where fewer channels than
        axes are present or their gradients do not span the space.
    """
    if not epochs:
        z, inputs = z.unsqueeze(0), {name: value.unsqueeze(0) for name, value in inputs.items()}
    lead = torch.broadcast_shapes(start.shape[:-1], z.shape[1:-1])  # type: ignore[no-untyped-call]
    position = start.expand(*lead, start.shape[-1])
    frame = frame or identity(position)
    noise = stacked_noise(sensors, frame.state(position), inputs, constants)
    present = ~torch.isnan(z)
    squares = _Squares(
        at=lambda unknown: linearised(sensors, constants, z, inputs, unknown, frame),
        inverse=Information(noise.independent, noise.common, present),
        sigma=noise.total.sqrt(),
        weigh=weigh,
        information=frame.information,
    )
    position, error, gradient = squares.descend(position, iterations)
    factor, regular = covariance_factor(squares.normal(squares.root(error), gradient)[0])
    known = regular & (present.sum((0, -1)) >= (frame.information == 0).sum())
    return Fix(
        torch.where(known.unsqueeze(-1), position, torch.nan),
        torch.where(known[..., None, None], factor, torch.nan),
    )


class _Squares(NamedTuple):
    """Weighted squares of the residuals, and how they are lowered.

    Attributes:
        at: unknowns (..., a) -> residuals (E, ..., m) and gradient of h (E, ..., m, a).
        inverse: R^-1; sigma: (E, ..., m), of the residuals.
        weigh: as for :func:`gauss_newton`; information: (a,), prior, of a :class:`Frame`.
    """

    at: Callable[[Tensor], tuple[Tensor, Tensor]]
    inverse: Information
    sigma: Tensor
    weigh: Weigh | None
    information: Tensor

    def root(self, error: Tensor) -> Tensor:
        """sqrt w (E, ..., m) of each residual."""
        if self.weigh is None:
            return torch.ones_like(error)
        return positive_sqrt(self.weigh(error / self.sigma))

    def cost(self, root: Tensor, error: Tensor, unknown: Tensor) -> Tensor:
        """(...), e^T M e and the prior's part."""
        prior = (self.information * unknown.square()).sum(-1)
        return self.inverse.square(root * error).sum(0) + prior

    def normal(self, root: Tensor, gradient: Tensor) -> tuple[Tensor, Tensor]:
        """H^T M H (..., a, a), and M H (E, ..., m, a) for the right-hand side."""
        scaled = root.unsqueeze(-1)
        weighted = scaled * self.inverse.times(scaled * gradient)
        matrix = (gradient.unsqueeze(-1) * weighted.unsqueeze(-2)).sum((0, -3))
        return matrix + torch.diag(self.information), weighted

    def descend(self, position: Tensor, iterations: int) -> tuple[Tensor, Tensor, Tensor]:
        """The position after so many steps, and residuals and gradient there."""
        damping = position.new_full(position.shape[:-1], FIRST_DAMPING)
        unit = torch.eye(position.shape[-1], dtype=position.dtype, device=position.device)
        error, gradient = self.at(position)
        # Near the minimum the costs differ by the rounding of z - h alone, and steps still improve.
        slack = 1.0 + 1e4 * torch.finfo(position.dtype).eps
        for _ in range(iterations):
            root = self.root(error)
            matrix, weighted = self.normal(root, gradient)
            downhill = (weighted * error.unsqueeze(-1)).sum((0, -2)) - self.information * position
            scale = matrix.diagonal(dim1=-2, dim2=-1).mean(-1)
            factor, regular = covariance_factor(matrix + (damping * scale)[..., None, None] * unit)
            shift = (factor @ (factor.mT @ downhill.unsqueeze(-1))).squeeze(-1)
            trial = position + torch.where(regular.unsqueeze(-1), shift, 0.0)
            new_error, new_gradient = self.at(trial)
            better = self.cost(root, new_error, trial) <= slack * self.cost(root, error, position)
            damping = torch.where(better, damping / DAMPING_FACTOR, damping * DAMPING_FACTOR)
            accept = better.unsqueeze(-1)
            position = torch.where(accept, trial, position)
            error = torch.where(accept, new_error, error)
            gradient = torch.where(accept.unsqueeze(-1), new_gradient, gradient)
        return position, error, gradient


def residual(sensors: Sequence[Sensor], z: Tensor, predicted: Sequence[Tensor]) -> Tensor:
    """Measurement minus the sensors' predictions, (..., m); 0 where missing."""
    parts, at = [], 0
    for sensor, h in zip(sensors, predicted, strict=True):
        part = z[..., at : at + h.shape[-1]]
        at += h.shape[-1]
        parts.append(sensor.residual(torch.where(torch.isnan(part), h, part), h))
    return torch.cat(parts, dim=-1)


def identity(like: Tensor) -> Frame:
    """The unknowns (..., a) are the state."""
    axes = like.shape[-1]
    zeros = like.new_zeros(axes)
    return Frame(torch.eye(axes, dtype=like.dtype, device=like.device), zeros, zeros)


def linearised(
    sensors: Sequence[Sensor],
    constants: Constants,
    z: Tensor,
    inputs: Inputs,
    unknown: Tensor,
    frame: Frame,
) -> tuple[Tensor, Tensor]:
    """Residual (..., m) and gradient of h towards the unknowns (..., m, a)."""
    state = frame.state(unknown)
    along = frame.along.expand(*state.shape[:-1], *frame.along.shape[-2:])
    observed = [sensor.observe(state, along, inputs, constants) for sensor in sensors]
    lead = torch.broadcast_shapes(*(gradient.shape[:-2] for _, gradient in observed))  # type: ignore[no-untyped-call]
    gradient = torch.cat([g.expand(*lead, *g.shape[-2:]) for _, g in observed], dim=-2)
    return residual(sensors, z, [h for h, _ in observed]), gradient
