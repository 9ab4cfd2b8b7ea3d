"""What a filter believes, what it is given, and what it tells about one step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.innovation import innovation_variance, log_densities, log_density, nis
from difffilter.core.linalg import semidefinite_cholesky
from difffilter.errors import InputError

__all__ = ["Belief", "Measurement", "Record", "belief"]


class Belief(NamedTuple):
    """Mean and deviations, P = X X^T; and what else the filter carries from step to step.

    Attributes:
        mean: (..., n).
        deviations: (..., n, n).
        memory: named tensors of an adaptation; empty for most filters.
    """

    mean: Tensor
    deviations: Tensor
    memory: Mapping[str, Tensor] = {}

    @property
    def covariance(self) -> Tensor:
        """(..., n, n)."""
        return self.deviations @ self.deviations.mT


class Measurement(NamedTuple):
    """One row of a log.

    Attributes:
        z: (..., m), NaN where a channel is missing.
        dt: seconds since the belief's time, scalar or (...).
        inputs: known inputs by name (anchor or platform positions, extra noise).
    """

    z: Tensor
    dt: Tensor
    inputs: Mapping[str, Tensor] = {}


class Record(NamedTuple):
    """What one step did; losses, metrics and plots are folds over these.

    Attributes:
        innovation: (..., m), nominal: before any weighing; 0 where missing.
        observed: (..., m, k), nominal deviations Z of the predicted measurement.
        noise: (..., m), nominal measurement noise variance.
        standardised: (..., m), residual that the weight saw, in sigmas.
        weight: (..., m), final weight; 0 where missing.
        prior_weight: (..., n), weight of the prediction's own residuals.
        gate: (..., m), 1 passed, 0 failed (between, when soft).
        modes: (..., K), probability of each mode of a mixture; K = 0 for all else.
        present: (..., m), whether the channel was measured (and its sensor not isolated).
        isolated: (..., m), whether a federated filter left the channel's sensor out because
            something of it was not finite.
    """

    innovation: Tensor
    observed: Tensor
    noise: Tensor
    standardised: Tensor
    weight: Tensor
    prior_weight: Tensor
    gate: Tensor
    modes: Tensor
    present: Tensor
    isolated: Tensor

    @property
    def innovation_variance(self) -> Tensor:
        """(..., m), nominal variance S_ii of each innovation."""
        return innovation_variance(self.observed, self.noise)

    @property
    def nis(self) -> Tensor:
        """(...), nu^T S^-1 nu over the present channels; 0 with none."""
        return nis(self.observed, self.noise, self.innovation, self.present)

    @property
    def log_densities(self) -> Tensor:
        """(..., m), log density of each innovation given those before it; 0 where missing."""
        return log_densities(self.observed, self.noise, self.innovation, self.present)

    @property
    def log_density(self) -> Tensor:
        """(...), log N(nu; 0, S) over the present channels; 0 with none."""
        return log_density(self.observed, self.noise, self.innovation, self.present)


def belief(mean: Tensor, covariance: Tensor, size: int | None = None) -> Belief:
    """Belief from a mean (..., n) and a positive semidefinite covariance (..., n, n).

    Args:
        size: rows of the covariance, where the mean has other numbers than its errors.

    Raises:
        InputError: shapes that do not fit, entries that are not finite, a covariance that
            is not symmetric or has a negative eigenvalue.
    """
    n = mean.shape[-1] if size is None else size
    if covariance.shape[-2:] != (n, n):
        raise InputError(
            f"covariance: found shape {list(covariance.shape)}, expected (..., {n}, {n})"
        )
    if not (torch.isfinite(mean).all() and torch.isfinite(covariance).all()):
        raise InputError("initial belief: found an entry that is not finite")
    scale = covariance.diagonal(dim1=-2, dim2=-1).abs().amax(-1)
    tolerance = 1e3 * torch.finfo(mean.dtype).eps * scale
    if bool(((covariance - covariance.mT).abs().amax((-1, -2)) > tolerance).any()):
        raise InputError("covariance: found an asymmetric matrix, expected a symmetric one")
    if bool((torch.linalg.eigvalsh(covariance)[..., 0] < -tolerance).any()):
        raise InputError("covariance: found a negative eigenvalue, expected none")
    deviations = semidefinite_cholesky(covariance)
    return Belief(mean, deviations.expand(*mean.shape[:-1], n, n))
