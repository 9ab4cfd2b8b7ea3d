"""Errors of measurements against truth: bias, spread, tails, and how they go on in time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Correlated", "Residuals", "correlated", "residuals"]

Array = NDArray[np.float64]
#: Normal distribution: standard deviation by median absolute deviation.
NORMAL = 1.482602218505602
#: Rows that a fit in time reads at most, the first ones.
MOST = 3000
#: Twice the gain in log likelihood from which on an error goes on in time (two parameters more).
GAIN = 15.0
#: Mean correlation between channels from which on an error is common to them.
COMMON = 0.3


@dataclass(frozen=True)
class Correlated:
    """White noise and a first-order Gauss-Markov error, fitted by likelihood.

    Attributes:
        white: standard deviation of what is new in each row.
        sigma, time: standard deviation and correlation time (s) of what goes on; 0 where
            nothing does.
    """

    white: float
    sigma: float
    time: float


@dataclass(frozen=True)
class Residuals:
    """Residuals of one channel: measurement minus what the truth gives.

    Attributes:
        count: how many; bias: their median; sigma: standard deviation by the median absolute
            deviation, which wild values do not move.
        tails: share beyond 3 of those sigmas (0.0027 if normal); largest: of all, absolute.
        own: how the error goes on in time.
        with_others: correlation with each other channel, by name.
    """

    count: int
    bias: float
    sigma: float
    tails: float
    largest: float
    own: Correlated
    with_others: dict[str, float]


def residuals(
    time: Array, errors: Array, names: Sequence[str]
) -> tuple[dict[str, Residuals], Correlated | None]:
    """Of errors (T, m), NaN where there is none; and the error that all channels share, if any.

    A common error is one whose mean correlation between channels is ``COMMON`` or more and
    which goes on in time; its sigma is the root of the mean covariance of different channels.
    """
    tame = np.full_like(errors, np.nan)
    found: dict[str, Residuals] = {}
    for i in range(len(names)):
        values = errors[:, i]
        if not (~np.isnan(values)).any():
            continue
        bias = float(np.nanmedian(values))
        sigma = NORMAL * float(np.nanmedian(np.abs(values - bias)))
        limit = 4.0 * sigma if sigma > 0.0 else np.inf
        tame[:, i] = np.clip(values - bias, -limit, limit)
    between = _correlations(tame)
    for i, name in enumerate(names):
        values = errors[:, i][~np.isnan(errors[:, i])]
        if not len(values):
            continue
        bias = float(np.median(values))
        sigma = NORMAL * float(np.median(np.abs(values - bias)))
        beyond = float((np.abs(values - bias) > 3.0 * sigma).mean()) if sigma > 0.0 else math.nan
        found[name] = Residuals(
            count=len(values),
            bias=bias,
            sigma=sigma,
            tails=beyond,
            largest=float(np.abs(values).max()),
            own=correlated(time, tame[:, i]),
            with_others={
                n: float(between[i, j])
                for j, n in enumerate(names) if j != i and not np.isnan(between[i, j])
            },
        )  # fmt: skip
    return found, _common(time, tame, between)


def _correlations(errors: Array) -> Array:
    """(m, m), of rows that both channels have; NaN where those are fewer than 10."""
    m = errors.shape[1]
    found = np.full((m, m), np.nan)
    for i in range(m):
        for j in range(m):
            both = ~np.isnan(errors[:, i]) & ~np.isnan(errors[:, j])
            a, b = errors[both, i], errors[both, j]
            scale = math.sqrt(float(a @ a) * float(b @ b)) if both.sum() >= 10 else 0.0
            if scale > 0.0:
                found[i, j] = float(a @ b) / scale
    return found


def _common(time: Array, errors: Array, between: Array) -> Correlated | None:
    m = errors.shape[1]
    others = between[~np.eye(m, dtype=bool)]
    others = others[~np.isnan(others)]
    if m < 2 or not len(others) or others.mean() < COMMON:
        return None
    here = ~np.isnan(errors)
    count = here.sum(1)
    total = np.where(here, errors, 0.0).sum(1)
    mean = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    fit = correlated(time, mean)
    pairs = count * (count - 1)
    covariance = (total**2 - np.where(here, errors**2, 0.0).sum(1)).sum() / pairs.sum()
    if fit.sigma == 0.0 or covariance <= 0.0:
        return None
    return Correlated(fit.white, math.sqrt(float(covariance)), fit.time)


def correlated(time: Array, errors: Array) -> Correlated:
    """White noise alone, or with a Gauss-Markov error where the likelihood gains by it.

    The error c of correlation time tau follows c(t + dt) = exp(-dt / tau) c(t) + noise; its
    likelihood is that of a scalar Kalman filter, over a grid of tau and of the share of c in
    the variance, refined once. The scale follows in closed form.
    """
    here = np.flatnonzero(~np.isnan(errors))[:MOST]
    z, dt = errors[here], np.diff(time[here], prepend=time[here[0]] if len(here) else 0.0)
    spread = math.sqrt(float(np.mean(z**2))) if len(z) else 0.0
    forward = dt[dt > 0.0]
    if len(z) < 30 or spread == 0.0 or not len(forward):
        return Correlated(spread, 0.0, 0.0)
    low, high = 0.5 * float(np.median(forward)), 0.25 * float(dt.sum())
    if high <= 2.0 * low:
        return Correlated(spread, 0.0, 0.0)
    taus, shares = np.geomspace(low, high, 16), np.linspace(0.05, 1.0, 12)
    for _ in range(2):
        tau, share = (x.ravel() for x in np.meshgrid(taus, shares, indexing="ij"))
        loss, scale = _likelihood(z, dt, tau, share)
        best = int(np.argmin(loss))
        step = taus[1] / taus[0]
        taus = np.geomspace(tau[best] / step, tau[best] * step, 15)
        gap = shares[1] - shares[0]
        shares = np.linspace(max(share[best] - gap, 1e-3), min(share[best] + gap, 1.0), 12)
    white = len(z) * (math.log(spread**2) + 1.0)
    if white - loss[best] < GAIN:
        return Correlated(spread, 0.0, 0.0)
    variance = scale[best]
    return Correlated(
        math.sqrt(variance * (1.0 - share[best])),
        math.sqrt(variance * share[best]),
        float(tau[best]),
    )


def _likelihood(z: Array, dt: Array, tau: Array, share: Array) -> tuple[Array, Array]:
    """Minus twice the log likelihood, up to a constant, and the variance, of each model."""
    mean, p = np.zeros_like(tau), share.copy()
    logs, squares = np.zeros_like(tau), np.zeros_like(tau)
    for value, step in zip(z.tolist(), dt.tolist(), strict=True):
        a = np.exp(-step / tau)
        mean, p = a * mean, a * a * p + (1.0 - a * a) * share
        s = p + (1.0 - share) + 1e-12
        innovation = value - mean
        gain = p / s
        mean, p = mean + gain * innovation, p - gain * p
        logs += np.log(s)
        squares += innovation * innovation / s
    variance = squares / len(z)
    return logs + len(z) * (np.log(variance) + 1.0), variance
