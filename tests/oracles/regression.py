"""Measurement updates as explicit weighted regressions, one belief at a time, plain NumPy."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Weight = Callable[[Array], Array]


def weighted_noise(noise: Array, weights: Array) -> Array:
    """R with R_ii -> R_ii / w_i (w > 0), the covariances between channels unchanged."""
    return noise + np.diag(np.diag(noise) * (1.0 / weights - 1.0))


def whitened(cov: Array, innovation: Array, rows: Array, noise: Array) -> tuple[Array, Array]:
    """A = L^-1 [I; H] and y = L^-1 [0; nu] with L L^T = blockdiag(P, R) (eqs. 15-18)."""
    n, m = rows.shape[1], rows.shape[0]
    joint = np.zeros((n + m, n + m))
    joint[:n, :n], joint[n:, n:] = cov, noise
    lower = np.linalg.cholesky(joint)
    design = np.linalg.solve(lower, np.vstack([np.eye(n), rows]))
    return design, np.linalg.solve(lower, np.concatenate([np.zeros(n), innovation]))


def weighted_ls(design: Array, target: Array, weights: Array) -> tuple[Array, Array]:
    """(A^T W A)^-1 A^T W y and (A^T W A)^-1 (eq. 27)."""
    normal = design.T @ np.diag(weights) @ design
    return np.linalg.solve(normal, design.T @ (weights * target)), np.linalg.inv(normal)


def m_estimate(
    cov: Array,
    innovation: Array,
    rows: Array,
    noise: Array,
    weight: Weight,
    iterations: int,
    floor: float | None = None,
    mad: bool = False,
) -> tuple[Array, Array, Array]:
    """Shift of the mean, covariance and all n + m weights after so many reweightings.

    Prior rows are weighed with floor + (1 - floor) w, or not at all if floor is None. With
    `mad` residuals are divided by 1.48 median |v - median v| over the rows that are weighed.
    """
    n = len(cov)
    design, target = whitened(cov, innovation, rows, noise)
    weighed = slice(n if floor is None else 0, None)
    weights = np.ones(len(target))
    shift, posterior = weighted_ls(design, target, weights)
    for _ in range(iterations):
        residual = (target - design @ shift)[weighed]
        if mad:
            residual = residual / (1.48 * np.median(np.abs(residual - np.median(residual))))
        weights[weighed] = weight(residual)
        if floor is not None:
            weights[:n] = floor + (1.0 - floor) * weights[:n]
        shift, posterior = weighted_ls(design, target, weights)
    return shift, posterior, weights
