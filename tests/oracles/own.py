"""An extended Kalman filter of any model in plain NumPy, and the gallery's models for it."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Own(NamedTuple):
    """A model: functions of numbers alone.

    Attributes:
        move: (state, dt, row) -> the state after; spread: (state, dt, row) -> Q.
        see: (state, row) -> (h, H); noise: (state, row) -> R; wraps: channels that are angles.
    """

    move: Callable[[Array, float, int], Array]
    spread: Callable[[Array, float, int], Array]
    see: Callable[[Array, int], tuple[Array, Array]]
    noise: Callable[[Array, int], Array]
    wraps: tuple[int, ...] = ()


def jacobian(function: Callable[[Array], Array], at: Array) -> Array:
    """By complex steps: exact to rounding, for functions of sums, products, sines and roots."""
    steps = at + 1e-30j * np.eye(len(at))
    return np.stack([np.imag(function(step)) / 1e-30 for step in steps], -1)


def ekf(
    own: Own, time: Array, z: Array, mean: Array, cov: Array, begin: float
) -> tuple[Array, Array]:
    """Means (T, n) and covariances (T, n, n); NaN is missing."""
    means, covs, before = [], [], begin
    for k, now in enumerate(time):
        dt = now - before
        jac = jacobian(lambda s: own.move(s, dt, k), mean)  # noqa: B023
        q = own.spread(mean, dt, k)
        mean, cov = np.real(own.move(mean, dt, k)), jac @ cov @ jac.T + q
        seen = ~np.isnan(z[k])
        h, rows = own.see(mean, k)
        nu = z[k] - h
        for i in own.wraps:
            nu[i] = (nu[i] + np.pi) % (2 * np.pi) - np.pi
        rows, r, nu = rows[seen], own.noise(mean, k)[np.ix_(seen, seen)], nu[seen]
        gain = cov @ rows.T @ np.linalg.inv(rows @ cov @ rows.T + r)
        keep = np.eye(len(mean)) - gain @ rows
        mean, cov = mean + gain @ nu, keep @ cov @ keep.T + gain @ r @ gain.T
        means.append(mean)
        covs.append(cov)
        before = now
    return np.array(means), np.array(covs)


def radar(v: dict[str, Array]) -> Own:
    """Coordinated turn of unknown rate; range, range rate, bearing."""

    def move(s: Array, dt: float, k: int) -> Array:
        x, y, vx, vy, w = s
        a = w * dt
        c, d = np.cos(a), np.sin(a)
        if abs(a) > 1e-2:
            along, across = d / w, (1 - c) / w
        else:  # their series: no difference of nearly equal numbers
            along = dt * (1 - a**2 / 6 + a**4 / 120 - a**6 / 5040)
            across = dt * (a / 2 - a**3 / 24 + a**5 / 720)
        return np.array([
            x + along * vx - across * vy, y + across * vx + along * vy,
            c * vx - d * vy, d * vx + c * vy, w,
        ])  # fmt: skip

    def spread(s: Array, dt: float, k: int) -> Array:
        push = np.array([[dt**2 / 2, 0], [0, dt**2 / 2], [dt, 0], [0, dt], [0, 0]])
        q = push @ push.T * v["motion.acceleration"] ** 2
        q[4, 4] = v["motion.turn_walk"] ** 2 * dt
        return q

    def see(s: Array, k: int) -> tuple[Array, Array]:
        x, y, vx, vy, _ = s
        r = np.hypot(x, y)
        rate = (x * vx + y * vy) / r
        rows = [
            [x / r, y / r, 0, 0, 0],
            [vx / r - rate * x / r**2, vy / r - rate * y / r**2, x / r, y / r, 0],
            [-y / r**2, x / r**2, 0, 0, 0],
        ]
        return np.array([r, rate, np.arctan2(y, x)]), np.array(rows)

    sigma = np.array([*v["radar.sigma"], v["angle.sigma"]])
    return Own(move, spread, see, lambda s, k: np.diag(sigma**2), (2,))
