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
        slope: (state, dt, row) -> F, where it is not that of ``move`` by complex steps.
        plus: (state, shift) -> state; carry: shift -> what takes deviations to the state there,
            for states that are no vectors.
    """

    move: Callable[[Array, float, int], Array]
    spread: Callable[[Array, float, int], Array]
    see: Callable[[Array, int], tuple[Array, Array]]
    noise: Callable[[Array, int], Array]
    wraps: tuple[int, ...] = ()
    slope: Callable[[Array, float, int], Array] | None = None
    plus: Callable[[Array, Array], Array] = np.add
    carry: Callable[[Array], Array] | None = None


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
        if own.slope is None:
            jac = jacobian(lambda s: own.move(s, dt, k), mean)  # noqa: B023
        else:
            jac = own.slope(mean, dt, k)
        q = own.spread(mean, dt, k)
        mean, cov = np.real(own.move(mean, dt, k)), jac @ cov @ jac.T + q
        seen = ~np.isnan(z[k])
        h, rows = own.see(mean, k)
        nu = z[k] - h
        for i in own.wraps:
            nu[i] = (nu[i] + np.pi) % (2 * np.pi) - np.pi
        rows, r, nu = rows[seen], own.noise(mean, k)[np.ix_(seen, seen)], nu[seen]
        gain = cov @ rows.T @ np.linalg.inv(rows @ cov @ rows.T + r)
        keep = np.eye(len(cov)) - gain @ rows
        shift, cov = gain @ nu, keep @ cov @ keep.T + gain @ r @ gain.T
        mean = own.plus(mean, shift)
        if own.carry is not None:
            cov = own.carry(shift) @ cov @ own.carry(shift).T
        means.append(mean)
        covs.append(cov)
        before = now
    return np.array(means), np.array(covs)


def radar(v: dict[str, Array], inputs: dict[str, Array]) -> Own:
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


def lorenz(v: dict[str, Array], inputs: dict[str, Array]) -> Own:
    """Fifth-order Taylor series of exp(A(x) dt), all states observed."""

    def move(s: Array, dt: float, k: int) -> Array:
        a = np.array([[-10, 10, 0], [v["lorenz.rho"], -1, -s[0]], [0, s[0], -8 / 3]]) * dt
        power, whole = np.eye(3), np.eye(3)
        for order in range(1, 6):
            power = power @ a / order
            whole = whole + power
        return whole @ s

    return Own(
        move,
        lambda s, dt, k: v["lorenz.walk"] ** 2 * dt * np.eye(3),
        lambda s, k: (s.copy(), np.eye(3)),
        lambda s, k: v["gauge.sigma"] ** 2 * np.eye(3),
    )


def cross(x: Array) -> Array:
    """[x]_x: the matrix of the cross product."""
    return np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])


def rotation(x: Array) -> Array:
    """Exp(x) as a matrix (Rodrigues)."""
    size = np.linalg.norm(x)
    k = cross(x / size)
    return np.eye(3) + np.sin(size) * k + (1 - np.cos(size)) * k @ k


def right(x: Array) -> Array:
    """The right Jacobian of Exp at x (Sola 2017, eq. 183)."""
    a = np.linalg.norm(x)
    k = cross(x)
    return np.eye(3) - (1 - np.cos(a)) / a**2 * k + (a - np.sin(a)) / a**3 * k @ k


def matrix(q: Array) -> Array:
    """Body to reference."""
    w, u = q[0], q[1:]
    return (w * w - u @ u) * np.eye(3) + 2 * np.outer(u, u) + 2 * w * cross(u)


def times(q: Array, x: Array) -> Array:
    """q turned by a rotation vector about the body's axes."""
    a = np.linalg.norm(x)
    w, u = np.cos(a / 2), np.sin(a / 2) * x / a
    turned = np.array([q[0] * w - q[1:] @ u, *(q[0] * u + w * q[1:] + np.cross(q[1:], u))])
    return turned / np.linalg.norm(turned)


def attitude(v: dict[str, Array], inputs: dict[str, Array]) -> Own:
    """Multiplicative EKF: gyros with a bias, accelerometer, magnetometer, exact reset."""
    gyros = np.stack([inputs[name] for name in ("gx", "gy", "gz")], -1)
    known = (np.array([0.0, 0.0, 9.81]), np.array([0.4, 0.0, -0.9]))

    def move(s: Array, dt: float, k: int) -> Array:
        return np.array([*times(s[:4], (gyros[k] - s[4:]) * dt), *s[4:]])

    def slope(s: Array, dt: float, k: int) -> Array:
        turn = (gyros[k] - s[4:]) * dt
        f = np.eye(6)
        f[:3, :3], f[:3, 3:] = rotation(turn).T, -right(turn) * dt
        return f

    def spread(s: Array, dt: float, k: int) -> Array:
        return dt * np.diag([v["gyro.noise"] ** 2] * 3 + [v["gyro.walk"] ** 2] * 3)

    def see(s: Array, k: int) -> tuple[Array, Array]:
        seen = [matrix(s[:4]).T @ vector for vector in known]
        rows = [np.hstack([cross(x), np.zeros((3, 3))]) for x in seen]
        return np.concatenate(seen), np.vstack(rows)

    def carry(shift: Array) -> Array:
        g = np.eye(6)
        g[:3, :3] = right(shift[:3])
        return g

    def plus(s: Array, shift: Array) -> Array:
        return np.array([*times(s[:4], shift[:3]), *(s[4:] + shift[3:])])

    sigma = np.repeat([v["force.sigma"], v["field.sigma"]], 3)
    noise = np.diag(sigma**2)
    return Own(move, spread, see, lambda s, k: noise, slope=slope, plus=plus, carry=carry)
