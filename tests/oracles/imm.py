"""The interacting-multiple-model estimator in covariance form (Blom and Bar-Shalom 1988), NumPy.

One trajectory, linear models; a channel that is NaN is missing.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Mode(NamedTuple):
    """F(dt), Q(dt), H and R of one model."""

    transition: Callable[[float], Array]
    noise: Callable[[float], Array]
    measured: Array
    variance: Array


def switching(rate: float, share: Array, dt: float) -> Array:
    """P_ij of a chain that at a rate draws its mode anew from the shares."""
    kept = np.exp(-rate * dt)
    return kept * np.eye(len(share)) + (1.0 - kept) * share


def imm(
    modes: Sequence[Mode],
    rate: float,
    share: Array,
    times: Array,
    z: Array,
    mean: Array,
    cov: Array,
    first: Array,
) -> tuple[Array, Array, Array]:
    """Means (T, n), covariances (T, n, n) and mode probabilities (T, K); ``first`` at the start."""
    count = len(modes)
    means, covs = [mean] * count, [cov] * count
    probability, now = first, 0.0
    found = []
    for time, row in zip(times, z, strict=True):
        dt, now = time - now, time
        chain = switching(rate, share, dt)
        predicted = probability @ chain
        mixed = chain * probability[:, None] / predicted[None, :]
        priors = []
        for j in range(count):
            m = sum(mixed[i, j] * means[i] for i in range(count))
            p = sum(
                mixed[i, j] * (covs[i] + np.outer(means[i] - m, means[i] - m)) for i in range(count)
            )
            priors.append((m, p))
        likelihood = np.zeros(count)
        for j, mode in enumerate(modes):
            f, h = mode.transition(dt), mode.measured
            m, p = f @ priors[j][0], f @ priors[j][1] @ f.T + mode.noise(dt)
            here = ~np.isnan(row)
            h, r, nu = h[here], mode.variance[np.ix_(here, here)], row[here] - h[here] @ m
            s = h @ p @ h.T + r
            gain = p @ h.T @ np.linalg.inv(s)
            means[j], covs[j] = m + gain @ nu, p - gain @ s @ gain.T
            likelihood[j] = -0.5 * (
                nu @ np.linalg.solve(s, nu) + np.log(np.linalg.det(2 * np.pi * s))
            )
        logarithm = np.log(predicted) + likelihood
        probability = np.exp(logarithm - logarithm.max())
        probability = probability / probability.sum()
        m = sum(probability[j] * means[j] for j in range(count))
        p = sum(
            probability[j] * (covs[j] + np.outer(means[j] - m, means[j] - m)) for j in range(count)
        )
        found.append((m, p, probability))
    return tuple(np.stack(part) for part in zip(*found, strict=True))  # type: ignore[return-value]
