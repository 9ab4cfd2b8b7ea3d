"""Cubature Kalman filters of paper 4 in covariance form, plain NumPy, one trajectory at a time.

States are [x, y, vx, vy]; the filters of :data:`FILTERS` and :func:`fusion` measure the position
with independent noise, and step with T = 1 s and Q = I, as both scenes do.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Function = Callable[[Array], Array]
Filter = Callable[[Array, Array, Array, Array], tuple[Array, Array]]

T = 1.0
F = np.array([[1.0, 0, T, 0], [0, 1, 0, T], [0, 0, 1, 0], [0, 0, 0, 1]])
H = np.eye(2, 4)
Q = np.eye(4)


def cubature_points(mean: Array, cov: Array) -> Array:
    """(2n, n): mean +- sqrt(n) times each column of the lower Cholesky factor."""
    n = len(mean)
    spread = np.sqrt(n) * np.linalg.cholesky(cov).T
    return np.concatenate([mean + spread, mean - spread])


def ckf_predict(mean: Array, cov: Array, f: Function, process: Array) -> tuple[Array, Array]:
    """Sample mean and covariance of the moved points, plus Q."""
    moved = np.array([f(point) for point in cubature_points(mean, cov)])
    centred = moved - moved.mean(0)
    return moved.mean(0), centred.T @ centred / len(moved) + process


def ckf_moments(mean: Array, cov: Array, h: Function, period: Array) -> tuple[Array, Array, Array]:
    """Mean of h, its covariance without R, and P_xz; rows of finite period are angles."""
    points = cubature_points(mean, cov)
    centre = h(mean)
    seen = centre + wrapped(np.array([h(point) for point in points]) - centre, period)
    z = seen.mean(0)
    y, x = seen - z, points - mean
    return z, y.T @ y / len(points), x.T @ y / len(points)


def wrapped(difference: Array, period: Array) -> Array:
    """The nearest of the differences that the period allows; inf for no period."""
    turns = np.where(np.isinf(period), 0.0, np.round(difference / period))
    return difference - turns * np.where(np.isinf(period), 0.0, period)


def ckf_update(
    mean: Array, cov: Array, h: Function, z: Array, noise: Array, period: Array
) -> tuple[Array, Array, Array, Array]:
    """Mean, covariance, innovation and P_zz; NaN in z is a missing channel."""
    there = ~np.isnan(z)
    predicted, cov_z, cross = ckf_moments(mean, cov, h, period)
    e = np.where(there, wrapped(np.nan_to_num(z) - predicted, period), 0.0)
    s = (cov_z + noise)[np.ix_(there, there)]
    gain = cross[:, there] @ np.linalg.inv(s)
    return mean + gain @ e[there], cov - gain @ s @ gain.T, e, cov_z + noise


def predict(mean: Array, cov: Array) -> tuple[Array, Array]:
    return F @ mean, F @ cov @ F.T + Q


def update(mean: Array, cov: Array, z: Array, noise: Array) -> tuple[Array, Array]:
    """Kalman update by a measured position, Joseph's form; noise (2,) are variances."""
    gain = cov @ H.T @ np.linalg.inv(H @ cov @ H.T + np.diag(noise))
    keep = np.eye(4) - gain @ H
    posterior = keep @ cov @ keep.T + gain @ np.diag(noise) @ gain.T
    return mean + gain @ (z - H @ mean), 0.5 * (posterior + posterior.T)


def theoretical(cov: Array, noise: Array) -> Array:
    """diag P_zz."""
    return np.diag(H @ cov @ H.T) + noise


class Matching:
    """(b): flags and inflated noise from the history of squared innovations."""

    def __init__(self, beta: float = 9.0, window: int = 4, rate: float | None = None) -> None:
        self.beta, self.window, self.m = beta, window, 0
        self.rate = 1.0 / window if rate is None else rate
        self.past: list[Array] = []

    def noise(self, e: Array, p_zz: Array, noise: Array) -> tuple[bool, Array]:
        """Whether the row is flagged, and its noise."""
        if not self.past:
            self.past = [p_zz] * (self.window - 1)
        actual = self.rate * e**2 + (1 - self.rate) * np.mean(self.past, axis=0)
        flagged = bool(actual.sum() > self.beta * (1 + self.m) ** 2 * p_zz.sum())
        self.past = [*self.past[1:], p_zz if flagged else e**2]
        self.m = self.m + 1 if flagged else 0
        return flagged, np.maximum(noise, actual - (p_zz - noise)) if flagged else noise


def excess(e: Array, p_zz: Array, threshold: float = 2.0) -> Array:
    """(c): sign(e) max(0, |e| - lambda sqrt(P_zz))."""
    return np.sign(e) * np.maximum(0.0, np.abs(e) - threshold * np.sqrt(p_zz))


def correct(mean: Array, d: Array, m: int = 0) -> Array:
    """Position by d, velocity by d / ((m + 1) T)."""
    return mean + np.concatenate([d, d / ((m + 1) * T)])


def run(
    z: Array, mean: Array, cov: Array, step: Callable[[Array, Array, Array], tuple[Array, Array]]
) -> tuple[Array, Array]:
    """Predict and step over the rows; a row of NaN is prediction alone."""
    means, covs = [], []
    for row in z:
        mean, cov = predict(mean, cov)
        if not np.isnan(row).any():
            mean, cov = step(mean, cov, row)
        means.append(mean)
        covs.append(cov)
    return np.array(means), np.array(covs)


def srckf(z: Array, mean: Array, cov: Array, noise: Array) -> tuple[Array, Array]:
    """(a): linear, so it is the Kalman filter."""
    return run(z, mean, cov, lambda m, p, row: update(m, p, row, noise))


def robust_srckf(z: Array, mean: Array, cov: Array, noise: Array) -> tuple[Array, Array]:
    """(b)."""
    matching = Matching()

    def step(mean: Array, cov: Array, row: Array) -> tuple[Array, Array]:
        _, raised = matching.noise(row - H @ mean, theoretical(cov, noise), noise)
        return update(mean, cov, row, raised)

    return run(z, mean, cov, step)


def lcasrckf(z: Array, mean: Array, cov: Array, noise: Array) -> tuple[Array, Array]:
    """(c)."""

    def step(mean: Array, cov: Array, row: Array) -> tuple[Array, Array]:
        d = excess(row - H @ mean, theoretical(cov, noise))
        return update(correct(mean, d), cov, row, noise)

    return run(z, mean, cov, step)


def matched_and_corrected(z: Array, mean: Array, cov: Array, noise: Array) -> tuple[Array, Array]:
    """(b), then (c) with the raised noise and the count m of flagged rows before."""
    matching = Matching()

    def step(mean: Array, cov: Array, row: Array) -> tuple[Array, Array]:
        e, before = row - H @ mean, matching.m
        _, raised = matching.noise(e, theoretical(cov, noise), noise)
        d = excess(e, theoretical(cov, raised))
        return update(correct(mean, d, before), cov, row, raised)

    return run(z, mean, cov, step)


class Average:
    """V of (d) and (e)."""

    def __init__(self, rho: float = 0.95) -> None:
        self.rho, self.v = rho, None

    def with_row(self, e: Array) -> Array:
        square = np.outer(e, e)
        self.v = square if self.v is None else (self.rho * self.v + square) / (1 + self.rho)
        return self.v


def stf_srckf(z: Array, mean: Array, cov: Array, noise: Array) -> tuple[Array, Array]:
    """(d), with beta_s = 4.5."""
    average = Average()

    def step(mean: Array, cov: Array, row: Array) -> tuple[Array, Array]:
        bar = (np.linalg.inv(cov) @ cov @ H.T).T
        n = average.with_row(row - H @ mean) - bar @ Q @ bar.T - 4.5 * np.diag(noise)
        below = H @ cov @ H.T - bar @ Q @ bar.T
        factor = max(1.0, np.trace(n) / np.trace(below))
        return update(mean, factor * (cov - Q) + Q, row, noise)

    return run(z, mean, cov, step)


def rmckf(z: Array, mean: Array, cov: Array, noise: Array) -> tuple[Array, Array]:
    """(e), with k = 1.345."""
    average = Average()

    def step(mean: Array, cov: Array, row: Array) -> tuple[Array, Array]:
        e = row - H @ mean
        raised = noise / np.minimum(1.0, 1.345 * np.sqrt(noise) / np.maximum(np.abs(e), 1e-300))
        bar = (np.linalg.inv(cov) @ cov @ H.T).T
        n = average.with_row(e) - bar @ Q @ bar.T - 4.5 * np.diag(raised)
        below = H @ cov @ H.T - bar @ Q @ bar.T
        c = np.maximum(1.0, np.diag(n) / np.diag(below))
        a = np.abs(bar @ F)
        a = a / a.sum(0)
        root = np.diag(np.sqrt(np.maximum(1.0, a.T @ c)))
        return update(mean, root @ (cov - Q) @ root + Q, row, raised)

    return run(z, mean, cov, step)


#: By the scenes' names of systems.
FILTERS: dict[str, Filter] = {
    "srckf": srckf,
    "robust-srckf": robust_srckf,
    "lcasrckf": lcasrckf,
    "stf-srckf": stf_srckf,
    "rmckf": rmckf,
}


def fusion(
    z: Array, mean: Array, cov: Array, robust_noise: Array, coarse_noise: Array
) -> tuple[Array, Array, Array]:
    """(f): means, covariances and flags over z (T, 6), the robust sensor's rows first."""
    matching = Matching()
    parts = [(mean, cov)] * 3
    means, covs, flags = [], [], []
    for row in z:
        z_robust, *z_coarse = np.split(row, 3)
        priors = [predict(*part) for part in parts]
        e, before = z_robust - H @ priors[0][0], matching.m
        q, raised = matching.noise(e, theoretical(priors[0][1], robust_noise), robust_noise)
        x_robust, p_robust = update(*priors[0], z_robust, raised)
        handed = H @ x_robust if q else z_robust
        info, coarse = 1 / raised, 0 * coarse_noise if q else 1 / coarse_noise
        new, corrected, any_corrected = [], [], False
        for (m, p), own in zip(priors[1:], z_coarse, strict=True):
            fused_noise = 1 / (info + coarse)
            fused = fused_noise * (info * handed + coarse * own)
            d = excess(fused - H @ m, theoretical(p, fused_noise))
            moved = correct(m, d, before)
            any_corrected = any_corrected or bool(d.any())
            corrected.append((moved, np.linalg.inv(p)))
            new.append(update(moved, p, fused, fused_noise))
        p_t = np.linalg.inv(np.mean([inverse for _, inverse in corrected], axis=0))
        x_t = p_t @ np.mean([inverse @ m for m, inverse in corrected], axis=0)
        if not q and any_corrected:
            x_robust, p_robust = update(x_t, priors[0][1], z_robust, raised)
        parts = [(x_robust, p_robust), *new]
        last = 1 / (info + 2 * coarse)
        z_last = last * (info * handed + coarse * (z_coarse[0] + z_coarse[1]))
        x_out, p_out = update(x_t, p_t, z_last, last)
        means.append(x_out)
        covs.append(p_out)
        flags.append(q)
    return np.array(means), np.array(covs), np.array(flags)
