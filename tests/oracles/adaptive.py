"""Adaptive extended Kalman filter: scales of Q and R from the innovations, plain NumPy."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from . import airport, textbook
from .textbook import transpose

Array = NDArray[np.float64]


def adaptive_ekf(
    data: dict[str, Array],
    sigma_ns: float = 10.0,
    window: int = 20,
    bounds_r: tuple[float, float] = (0.1, 1000.0),
    bounds_q: tuple[float, float] = (0.1, 10.0),
    common: bool = False,
) -> tuple[Array, Array]:
    """Extended Kalman filter that uses a Q_0 and b R_0, with a and b from a window of steps.

    At step k, with P^- = F P F^T + a_k Q_0, innovation nu, S = H P^- H^T + b_k R_0, posterior
    m = m^- + K nu and P, residual eps = nu - H K nu, and |v|^2 = v^T R_0^-1 v / 7,
    tr(A) = trace(R_0^-1 A) / 7, three numbers enter a ring buffer of N = `window` entries:
        rho_k = |eps|^2 + tr(H P H^T)     E[eps eps^T] = R - H P H^T
        iota_k = |nu|^2                   E[nu nu^T] = H P^- H^T + R
        pi_k = tr(H P^- H^T).
    Once the buffer is full (k >= N; until then a = b = 1), with means over the buffer,
        b_{k+1} = clip(mean rho, bounds_r)
        a_{k+1} = clip(a_k sqrt(max(mean iota - mean rho, 0) / mean pi), bounds_q),
    the residual-based R (Mohamed and Schwarz 1999; never negative) and the innovation-based
    scaling of Q (Ding, Wang, Rizos and Kinlyside 2007). Memory: 3 N numbers per run.
    """
    base = airport.noise_covariance(sigma_ns, common)
    information = np.linalg.inv(base) / 7
    transition, process = textbook.motion()
    mean = data["initial_mean"]
    runs = len(mean)
    cov = np.broadcast_to(data["initial_covariance"], (runs, 4, 4))
    a, b = np.ones(runs), np.ones(runs)
    buffer = np.zeros((runs, window, 3))
    means, covs = [], []
    for k in range(1, data["measurements"].shape[1]):
        mean, cov = textbook.predict(mean, cov, transition, a[:, None, None] * process)
        innovation, rows = textbook.linearise(mean, data["measurements"][:, k])
        spread = rows @ cov @ transpose(rows)
        noise = b[:, None, None] * base
        prior = mean
        mean, cov = textbook.kalman_update(mean, cov, innovation, rows, noise)
        residual = innovation - (rows @ (mean - prior)[..., None])[..., 0]
        after = rows @ cov @ transpose(rows)
        entry = buffer[:, (k - 1) % window]
        entry[:, 0] = _square(residual, information) + _trace(information @ after)
        entry[:, 1] = _square(innovation, information)
        entry[:, 2] = _trace(information @ spread)
        if k >= window:
            rho, iota, pi = buffer.mean(1).T
            b = np.clip(rho, *bounds_r)
            a = np.clip(a * np.sqrt(np.maximum(iota - rho, 0.0) / pi), *bounds_q)
        means.append(mean)
        covs.append(cov)
    return np.stack(means, 1), np.stack(covs, 1)


def _square(vector: Array, matrix: Array) -> Array:
    """v^T M v of each vector."""
    return np.einsum("...i,ij,...j->...", vector, matrix, vector)


def _trace(matrix: Array) -> Array:
    """Trace of each matrix."""
    return np.trace(matrix, axis1=-2, axis2=-1)


def adaptive_m_ekf(
    data: dict[str, Array],
    weight: Callable[[Array], Array],
    iterations: int,
    floor: float,
    window: int,
    bounds_r: tuple[float, float],
    bounds_q: tuple[float, float],
    common: bool,
) -> tuple[Array, Array]:
    """The same scales, around an update whose channels and prior rows are reweighted."""
    base = airport.noise_covariance(10.0, common)
    information = np.linalg.inv(base) / 7
    transition, process = textbook.motion()
    means, covs = [], []
    for run, start in enumerate(data["initial_mean"]):
        mean, cov = start, np.broadcast_to(data["initial_covariance"], (run + 1, 4, 4))[run]
        a, b, ring = 1.0, 1.0, np.zeros((0, 3))
        for z in data["measurements"][run, 1:]:
            prior, cov = (
                x[0] for x in textbook.predict(mean[None], cov[None], transition, a * process)
            )
            nu, rows = (x[0] for x in textbook.linearise(prior[None], z[None]))
            noise, root = b * base, np.linalg.cholesky(cov)
            w, prior_w, spread = np.ones(7), np.ones(4), rows @ cov @ rows.T
            for left in range(iterations, -1, -1):
                wide = root @ np.diag(1.0 / prior_w) @ root.T
                r = noise + np.diag(np.diag(noise) * (1.0 / w - 1.0))
                gain = wide @ rows.T @ np.linalg.inv(rows @ wide @ rows.T + r)
                shift, cov = gain @ nu, wide - gain @ rows @ wide
                residual = nu - rows @ shift
                if left:
                    w = weight(residual / np.sqrt(np.diag(noise)))
                    prior_w = floor + (1.0 - floor) * weight(np.linalg.solve(root, shift))
            mean, traced = prior + shift, np.trace(information @ rows @ cov @ rows.T)
            entry = residual @ information @ residual + traced, nu @ information @ nu
            ring = np.vstack([ring, [*entry, np.trace(information @ spread)]])[-window:]
            if len(ring) == window:
                rho, iota, pi = ring.mean(0)
                b = np.clip(rho, *bounds_r)
                a = np.clip(a * np.sqrt(max(iota - rho, 0.0) / pi), *bounds_q)
            means.append(mean)
            covs.append(cov)
    shape = len(data["initial_mean"]), -1
    return np.stack(means).reshape(*shape, 4), np.stack(covs).reshape(*shape, 4, 4)
