"""Federated Kalman filter with fusion-reset, and credibility (paper 2), plain NumPy.

One trajectory, linear measurements y = C x + v of several systems, everything in the
information form of textbooks: inverse covariances, local filters one after the other.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import kinematics

Array = NDArray[np.float64]
#: Matrix C, variances R (a covariance), measurement y of one system.
Local = tuple[Array, Array, Array]


def federated_step(
    mean: Array,
    covariance: Array,
    transition: Array,
    process: Array,
    systems: Sequence[Local],
    shares: Sequence[float],
) -> tuple[Array, Array]:
    """Information sharing, N local filters, fusion and reset (paper 2, eqs. 1-7).

    P_i = P / beta_i, Q_i = Q / beta_i, x_i = x; predict x_i = F x_i, P_i = F P_i F^T + Q_i;
    update P_i = (P_i^-1 + C_i^T R_i^-1 C_i)^-1, x_i = x_i + P_i C_i^T R_i^-1 (y_i - C_i x_i);
    fusion P = (sum P_i^-1)^-1, x = P sum P_i^-1 x_i.
    """
    information, vector = np.zeros_like(covariance), np.zeros_like(mean)
    for (rows, noise, y), share in zip(systems, shares, strict=True):
        local = transition @ mean
        spread = transition @ (covariance / share) @ transition.T + process / share
        gained = rows.T @ np.linalg.inv(noise)
        inverse = np.linalg.inv(spread) + gained @ rows
        local = local + np.linalg.inv(inverse) @ gained @ (y - rows @ local)
        information += inverse
        vector += inverse @ local
    fused = np.linalg.inv(information)
    return fused @ vector, fused


def central_step(
    mean: Array,
    covariance: Array,
    transition: Array,
    process: Array,
    systems: Sequence[Local],
) -> tuple[Array, Array]:
    """The same measurements in one Kalman filter, covariance form."""
    rows = np.concatenate([rows for rows, _, _ in systems])
    y = np.concatenate([y for _, _, y in systems])
    noise = np.zeros((len(y), len(y)))
    at = 0
    for _, block, own in systems:
        noise[at : at + len(own), at : at + len(own)] = block
        at += len(own)
    mean = transition @ mean
    covariance = transition @ covariance @ transition.T + process
    gain = covariance @ rows.T @ np.linalg.inv(rows @ covariance @ rows.T + noise)
    return mean + gain @ (y - rows @ mean), covariance - gain @ rows @ covariance


@dataclass
class Mapping:
    """Values of the credibility mapping; the published point by default."""

    rate: float = 0.1
    power: float = 1.0
    floor: float = 0.0
    followed: float = 0.0
    kappa: float = 0.0
    drift_rate: float = 0.05


@dataclass
class Told:
    """What the ideal filter is told: of each channel, and the level of the process noise.

    errors, variances: (T, m); levels: (T,), NaN where the filter's own holds.
    """

    errors: Array
    variances: Array
    levels: Array


def credibility_run(
    z: Array,
    dt: Array,
    mean: Array,
    covariance: Array,
    density: float,
    variances: Array,
    systems: Sequence[Sequence[int]],
    axes: int,
    mapping: Mapping,
    told: Told | None = None,
    shares: Sequence[float] = (),
) -> tuple[Array, Array, Array]:
    """Credibility-weighted federated filter: means, covariances, gammas (T, N).

    The reading with conserved total information. Channel c of system i measures the
    position of axis (its place within i) with variance R_c. At each row, over present channels:

        w = y - C x(k|k-1),  R'_c = (1 - rate) R'_c + rate w^2, from R_c on
        R'_i, R_i = means of R'_c, R_c over i;  t_i = sum over i of P(k|k-1)_cc / R_c
        gamma_i ~ (sum over i of P(k|k-1)_cc) (R'_i + floor)^-power, their sum 1
        I = (1 - followed) sum t_i + followed sum t_i R_i / R'_i
        R_c -> R_c t_i / (gamma_i I)

    and the fusion. The credibility of the prediction, with K the gain of the fused update:

        u = (x(k|k) - x(k|k-1)) / sqrt diag(K diag(R'_c) K^T), for each position; 0 of an axis
            that is not measured (axes are independent)
        D = (1 - b) D + b u, if anything was measured
        q^2 (1 + kappa max(0, mean(D^2) (2 - b) / b - 1)) at the next row.

    If told: R_c and R'_c from what it is told, published mapping, q of its level.
    """
    n, channels = 2 * axes, z.shape[1]
    place = {c: (i, axis) for i, own in enumerate(systems) for axis, c in enumerate(own)}
    matrix = np.zeros((channels, n))
    for c, (_, axis) in place.items():
        matrix[c, axis] = 1.0
    shares = list(shares) or [1.0 / len(systems)] * len(systems)
    averaged, drift = variances.astype(float).copy(), np.zeros(axes)
    means, covariances, gammas = [], [], []
    for k, y in enumerate(z):
        there = ~np.isnan(y)
        q, nominal = density, variances
        if told is not None:
            q = density if np.isnan(told.levels[k]) else told.levels[k]
            nominal = told.variances[k]
        elif mapping.kappa:
            b = mapping.drift_rate
            excess = (drift**2).mean() * (2.0 - b) / b - 1.0
            q = density * np.sqrt(1.0 + mapping.kappa * max(0.0, excess))
        transition = kinematics.transition(axes, dt[k])
        process = kinematics.continuous_noise(q**2 * np.eye(axes), dt[k])
        prior = transition @ mean
        spread = transition @ covariance @ transition.T + process
        relative = y - matrix @ prior
        if told is None:
            fresh = (1.0 - mapping.rate) * averaged + mapping.rate * relative**2
            averaged = np.where(there, fresh, averaged)
        else:
            averaged = told.errors[k] ** 2
        score, own, declared, t = (np.zeros(len(systems)) for _ in range(4))
        p, floor = (mapping.power, mapping.floor) if told is None else (1.0, 0.0)
        for i, members in enumerate(systems):
            c = [c for c in members if there[c]]
            if not c:
                continue
            predicted = np.array([matrix[j] @ spread @ matrix[j] for j in c])
            own[i], declared[i] = averaged[c].mean(), nominal[c].mean()
            t[i] = (predicted / nominal[c]).sum()
            score[i] = predicted.sum() * (own[i] + floor) ** -p
        gamma = score / score.sum() if there.any() else score
        seen = t > 0
        f = mapping.followed if told is None else 0.0
        total = (1.0 - f) * t.sum() + f * (t[seen] * declared[seen] / own[seen]).sum()
        local: list[Local] = []
        for i, members in enumerate(systems):
            c = [c for c in members if there[c]]
            noise = nominal[c] * (t[i] / (gamma[i] * total) if c else 1.0)
            local.append((matrix[c], np.diag(noise), y[c]))
        mean, covariance = federated_step(mean, covariance, transition, process, local, shares)
        if there.any():
            rows = np.concatenate([rows for rows, _, _ in local])
            inverse = np.concatenate([1.0 / np.diag(noise) for _, noise, _ in local])
            order = [c for members in systems for c in members if there[c]]
            gain = covariance @ rows.T * inverse
            variance = (gain**2 * averaged[order]).sum(1)[:axes]
            known = np.array([any(place[c][1] == axis for c in order) for axis in range(axes)])
            u = np.where(known, (mean - prior)[:axes], 0.0) / np.sqrt(np.where(known, variance, 1))
            drift = (1.0 - mapping.drift_rate) * drift + mapping.drift_rate * u
        means.append(mean)
        covariances.append(covariance)
        gammas.append(gamma)
    return np.stack(means), np.stack(covariances), np.stack(gammas)
