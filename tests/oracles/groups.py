"""Channels that share one weight and one gate, in covariance form, plain NumPy.

One belief at a time: predicted mean and covariance, z = H x + noise of covariance R, NaN in the
innovation where a channel is missing. Groups are lists of channel numbers.
"""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from .regression import weighted_noise
from .textbook import kalman_update

Array = NDArray[np.float64]
Weight = Callable[[Array], Array]
Groups = Sequence[Sequence[int]]


def distances(
    residual: Array, covariance: Array, variance: Array, groups: Groups, distance: str
) -> Array:
    """Per channel that of its group: root of the mean of residual^2 / variance over the present
    channels ("rms"), or sqrt(e^T C^-1 e) of those ("mahalanobis"); 0 with none."""
    found = np.zeros(len(residual))
    for group in groups:
        here = [i for i in group if np.isfinite(residual[i])]
        e = residual[here]
        if not here:
            continue
        if distance == "rms":
            size = np.sqrt(np.mean(e**2 / variance[here]))
        else:
            size = np.sqrt(e @ np.linalg.inv(covariance[np.ix_(here, here)]) @ e)
        found[list(group)] = size
    return found


def update(
    mean: Array, cov: Array, innovation: Array, rows: Array, noise: Array, weights: Array
) -> tuple[Array, Array]:
    """Posterior mean and covariance from the channels of positive weight."""
    kept = weights > 0
    reduced = weighted_noise(noise[kept][:, kept], weights[kept])
    return kalman_update(mean, cov, innovation[kept], rows[kept], reduced)


def group_update(
    mean: Array,
    cov: Array,
    innovation: Array,
    rows: Array,
    noise: Array,
    groups: Groups,
    weight: Weight,
    standardise: str,
    distance: str,
    iterations: int = 0,
) -> tuple[Array, Array, Array]:
    """Posterior mean, covariance, and the weights: of the innovation (no iterations), or of the
    residuals of the estimate before, so many times from weight 1 on."""
    base = noise + (rows @ cov @ rows.T if standardise == "innovation" else 0.0)
    present = np.isfinite(innovation)
    residual, weights = innovation, present.astype(float)
    posterior = update(mean, cov, innovation, rows, noise, weights)
    for _ in range(max(iterations, 1)):
        if iterations:
            residual = innovation - rows @ (posterior[0] - mean)
        s = distances(residual, base, np.diag(base), groups, distance)
        weights = weight(s) * present
        posterior = update(mean, cov, innovation, rows, noise, weights)
    return (*posterior, weights)
