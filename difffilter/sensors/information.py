"""Information: the inverse of R for the present channels, and normal matrices to factors."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from difffilter.parameters.values import Constants
from difffilter.sensors.sensor import Inputs, Noise, Sensor

__all__ = [
    "Information",
    "block_diagonal",
    "common_columns",
    "common_noise",
    "covariance_factor",
    "stacked_noise",
]


def stacked_noise(
    sensors: Sequence[Sensor], mean: Tensor, inputs: Inputs, constants: Constants
) -> Noise:
    """Noise of all sensors' channels at a state (..., n): (..., m), (..., m, u) and (..., m)."""
    parts = [sensor.noise(mean, inputs, constants) for sensor in sensors]
    return Noise(
        _beside([part.independent for part in parts]),
        block_diagonal([part.common for part in parts]),
        _beside([part.total for part in parts]),
    )


def common_columns(sensor: Sensor) -> int:
    """How many columns of noise common to channels a sensor has, by its published values."""
    columns = getattr(sensor, "common_columns", None)
    if columns is None:
        constants = sensor.prepare({p.name: p.tensor() for p in sensor.parameters})
        columns = sensor.noise(torch.zeros(()), {}, constants).common.shape[-1]
    return int(columns)


def common_noise(sensor: Sensor) -> bool:
    """Whether the sensor has noise common to channels."""
    return bool(common_columns(sensor))


def _beside(parts: Sequence[Tensor]) -> Tensor:
    if all(part.dim() == 1 for part in parts):
        return torch.cat([*parts])
    lead = torch.broadcast_shapes(*(part.shape[:-1] for part in parts))  # type: ignore[no-untyped-call]
    return torch.cat([part.expand(*lead, part.shape[-1]) for part in parts], dim=-1)


def block_diagonal(parts: Sequence[Tensor]) -> Tensor:
    """(..., m, u) of blocks (..., m_i, u_i) along the diagonal."""
    if all(part.dim() == 2 for part in parts):
        return torch.block_diag(*parts)  # type: ignore[no-any-return, no-untyped-call]
    lead = torch.broadcast_shapes(*(part.shape[:-2] for part in parts))  # type: ignore[no-untyped-call]
    width, at, rows = sum(part.shape[-1] for part in parts), 0, []
    for part in parts:
        own = part.shape[-1]
        padded = torch.nn.functional.pad(part, (at, width - at - own))
        rows.append(padded.expand(*lead, *padded.shape[-2:]))
        at += own
    return torch.cat(rows, dim=-2)


class Information:
    """R^-1 of the present channels: a missing channel leaves R and has information 0.

    Args:
        independent: (..., m), r of R = diag(r) + common common^T, positive definite.
        common: (..., m, u); without columns everything stays diagonal.
        present: (..., m) of bool.
    """

    def __init__(self, independent: Tensor, common: Tensor, present: Tensor) -> None:
        self.diagonal = not common.shape[-1]
        if self.diagonal:
            self._inverse = present / independent
            return
        mask = present.to(independent.dtype)
        both = mask.unsqueeze(-1) * mask.unsqueeze(-2)
        noise = both * (torch.diag_embed(independent) + common @ common.mT)
        # A missing channel becomes an independent one of unit variance, left out below.
        lower = torch.linalg.cholesky(noise + torch.diag_embed(1.0 - mask))
        self._inverse = both * torch.cholesky_inverse(lower)

    @property
    def matrix(self) -> Tensor:
        """(..., m, m)."""
        return torch.diag_embed(self._inverse) if self.diagonal else self._inverse

    def times(self, x: Tensor) -> Tensor:
        """R^-1 x of columns (..., m, k)."""
        return self._inverse.unsqueeze(-1) * x if self.diagonal else self._inverse @ x

    def square(self, x: Tensor) -> Tensor:
        """x^T R^-1 x of each vector (..., m): (...)."""
        return (x * self.times(x.unsqueeze(-1)).squeeze(-1)).sum(-1)


def covariance_factor(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Factor F of the inverse of a normal matrix, F F^T = N^-1, and whether N is regular.

    Args:
        normal: (..., a, a), symmetric positive semidefinite.

    Returns:
        F (..., a, a), upper triangular, arbitrary but finite where N is singular to the
        precision; and (...) of bool.
    """
    diagonal = normal.diagonal(dim1=-2, dim2=-1)
    regular = (diagonal > 0).all(-1) & torch.isfinite(normal).all(-1).all(-1)
    unit = torch.eye(normal.shape[-1], dtype=normal.dtype, device=normal.device)
    # A unit diagonal makes the pivots comparable, whatever the units.
    scale = torch.where(regular.unsqueeze(-1), diagonal, 1.0).rsqrt()
    scaled = normal * scale.unsqueeze(-1) * scale.unsqueeze(-2)
    scaled = torch.where(regular[..., None, None], scaled, unit)
    pivots, failed = torch.linalg.cholesky_ex(scaled.detach())
    smallest = 32 * torch.finfo(normal.dtype).eps
    large = pivots.diagonal(dim1=-2, dim2=-1).square() > smallest
    regular = regular & (failed == 0) & large.all(-1)
    # A second factor: the gradient through a failed one is NaN, even where it is left out.
    lower = torch.linalg.cholesky_ex(torch.where(regular[..., None, None], scaled, unit)).L
    inverse = torch.linalg.solve_triangular(lower, unit.expand_as(lower), upper=False)
    return scale.unsqueeze(-1) * inverse.mT, regular
