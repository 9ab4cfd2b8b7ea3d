"""Bearings-only location from an aircraft: world, filters and batch solutions, plain NumPy.

Arrays are time-major: index i of the leading axis is the time k = i + 1, then come the runs.
The state is the emitter relative to the aircraft, (x, y, vx, vy).
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from . import kinematics, weights

Array = NDArray[np.float64]
Weight = Callable[[Array], Array]

STEPS = 200
STEP = 1.0
FIRST = 6
START = np.array([5000.0, 10000.0, -600.0, 0.0])
VELOCITY = START[2:]
SIGMA = np.radians(0.1)
POSITION_STD = 1000.0
ACCELERATION = 0.1
GATE = 7.879
TABLE_1 = {**dict.fromkeys(range(100, 111), 5.0), 130: 10.0, 140: 20.0, 160: 25.0}
MATCHED_DRIFT = 0.1


def wrap(angle: Array) -> Array:
    """Angle in (-pi, pi]."""
    return np.pi - np.mod(np.pi - angle, 2 * np.pi)


def faults(
    runs: int, rng: np.random.Generator, probability: float, low: float, high: float, sided: int
) -> tuple[Array, Array, Array]:
    """Random fault errors from k = FIRST on, in sigmas: error, and its mean and variance if told.

    With `probability` a bearing gets U(low, high), with `sided` = 2 of random sign. What is told
    is whether there is a fault and the distribution of its error, not its size or sign.
    """
    shape = (STEPS, runs)
    flag = (rng.random(shape) < probability) & (np.arange(1, STEPS + 1)[:, None] >= FIRST)
    sign = rng.choice([-1.0, 1.0], shape) if sided == 2 else 1.0
    error = flag * sign * rng.uniform(low, high, shape)
    square = (low**2 + low * high + high**2) / 3
    mean = 0.0 if sided == 2 else (low + high) / 2
    return error, flag * mean, flag * (square - mean**2)


def simulate(
    runs: int,
    rng: np.random.Generator,
    outliers: bool = False,
    drift: float = 0.0,
    multipath: bool = False,
    matched: bool = False,
) -> dict[str, Array]:
    """Draw truth (200, runs, 4), bearings (200, runs) and the moments of the fault errors.

    fault_mean and fault_variance (200, runs), in rad and rad^2, are what a clairvoyant is told.
    `outliers`: Table 1. `multipath`: U(2, 10) sigma with probability 0.15. `matched`: drift
    MATCHED_DRIFT and +-U(5, 25) sigma with probability 0.08. `drift` is the standard deviation
    of the emitter's acceleration per axis. The noise and the drift come first from `rng`, so one
    seed gives the same ones with and without faults.
    """
    drift = MATCHED_DRIFT if matched else drift
    noise = SIGMA * rng.standard_normal((STEPS, runs))
    acceleration = drift * rng.standard_normal((STEPS, runs, 2))
    truth = np.empty((STEPS, runs, 4))
    state = np.tile(START, (runs, 1))
    for i in range(STEPS):
        push = acceleration[i]
        position = state[:, :2] + state[:, 2:] * STEP + push * STEP**2 / 2
        state = np.concatenate([position, state[:, 2:] + push * STEP], axis=-1)
        truth[i] = state
    error = np.zeros((STEPS, runs))
    mean = np.zeros((STEPS, runs))
    variance = np.zeros((STEPS, runs))
    if outliers:
        for k, size in TABLE_1.items():
            error[k - 1] = mean[k - 1] = size
    if multipath:
        error, mean, variance = faults(runs, rng, 0.15, 2.0, 10.0, 1)
    if matched:
        error, mean, variance = faults(runs, rng, 0.08, 5.0, 25.0, 2)
    return {
        "truth": truth,
        "bearings": wrap(np.arctan2(truth[..., 1], truth[..., 0]) + noise + SIGMA * error),
        "fault_mean": SIGMA * mean,
        "fault_variance": SIGMA**2 * variance,
    }


def travelled() -> Array:
    """Change of the relative position since k = 0 for a static emitter: (200, 2)."""
    return np.arange(1, STEPS + 1)[:, None] * STEP * VELOCITY


def triangulate(z: Array) -> Array:
    """Pseudo-linear least squares over all bearings so far: relative position at k = 0, (T, B, 2).

    n = (sin z, -cos z) is normal to the line of sight, so n . (p + u_k) = 0 for the displacement
    u_k. NaN at k = 1, where one line does not meet another.
    """
    normal = np.stack([np.sin(z), -np.cos(z)], axis=-1)
    information = np.cumsum(normal[..., :, None] * normal[..., None, :], axis=0)
    offset = (normal * travelled()[: len(z), None]).sum(-1, keepdims=True)
    vector = -np.cumsum(normal * offset, axis=0)
    position = np.full(normal.shape, np.nan)
    position[1:] = np.linalg.solve(information[1:], vector[1:, ..., None])[..., 0]
    return position


def initial(z: Array, first: int = FIRST) -> Array:
    """State at k = 0 from the first bearings and the known velocity: (T, B) -> (B, 4)."""
    position = triangulate(z[:first])[-1]
    return np.concatenate([position, np.broadcast_to(VELOCITY, position.shape)], axis=-1)


def ls(z: Array) -> Array:
    """Relative position at each k by pseudo-linear least squares of the bearings up to k."""
    return triangulate(z) + travelled()[: len(z), None]


def weighted_ls(z: Array, iterations: int = 3) -> Array:
    """The same by Gauss-Newton on the wrapped bearing residuals: maximum likelihood, (T, B, 2).

    Each k starts from the estimate of k - 1, k = 2 from the pseudo-linear one.
    """
    shift = travelled()[: len(z), None]
    estimate = np.full((*z.shape, 2), np.nan)
    position = triangulate(z[:2])[1]
    for k in range(2, len(z) + 1):
        for _ in range(iterations):
            x, y = np.moveaxis(position + shift[:k], -1, 0)
            square = x**2 + y**2
            residual = wrap(z[:k] - np.arctan2(y, x))
            hx, hy = -y / square, x / square
            xx, xy, yy = (hx * hx).sum(0), (hx * hy).sum(0), (hy * hy).sum(0)
            bx, by = (hx * residual).sum(0), (hy * residual).sum(0)
            step = np.stack([yy * bx - xy * by, xx * by - xy * bx], axis=-1)
            position = position + step / (xx * yy - xy**2)[:, None]
        estimate[k - 1] = position + shift[k - 1]
    return estimate


def update(
    mean: Array, cov: Array, innovation: Array, row: Array, noise: Array, weight: Array
) -> tuple[Array, Array]:
    """Scalar Kalman update with R -> R / w in Joseph form; w = 0 leaves mean and covariance.

    K = w P h / (w h^T P h + R); m + K nu; (I - K h^T) P (I - K h^T)^T + K (R / w) K^T.
    """
    cross = (cov @ row[..., None])[..., 0]
    unit = cross / (weight * (row * cross).sum(-1) + noise)[:, None]
    gain = weight[:, None] * unit
    keep = np.eye(mean.shape[-1]) - gain[:, :, None] * row[:, None, :]
    added = (weight * noise)[:, None, None] * unit[:, :, None] * unit[:, None, :]
    return mean + gain * innovation[:, None], keep @ cov @ np.swapaxes(keep, -1, -2) + added


def run_filter(
    z: Array,
    weigh: Callable[[Array, Array, Array], Array],
    q: float = ACCELERATION,
    sigma: float = SIGMA,
    position_std: float = POSITION_STD,
    bias: Array | None = None,
    extra: Array | None = None,
) -> tuple[Array, Array]:
    """Predict and update from k = 1 on: means (T, B, 4) and covariances (T, B, 4, 4).

    weigh(innovation, its predicted variance h^T P h + R, R) gives w. `bias` and `extra` (T, B)
    are subtracted from the innovation and added to R.
    """
    transition = kinematics.transition(2, STEP)
    process = kinematics.discrete_noise(q**2 * np.eye(2), STEP)
    mean = initial(z)
    cov = np.tile(np.diag([position_std**2, position_std**2, 0.0, 0.0]), (len(mean), 1, 1))
    means, covs = [], []
    for i in range(len(z)):
        mean = mean @ transition.T
        cov = transition @ cov @ transition.T + process
        square = mean[:, 0] ** 2 + mean[:, 1] ** 2
        row = np.zeros_like(mean)
        row[:, 0], row[:, 1] = -mean[:, 1] / square, mean[:, 0] / square
        shift = 0.0 if bias is None else bias[i]
        innovation = wrap(z[i] - np.arctan2(mean[:, 1], mean[:, 0]) - shift)
        noise = np.full(len(mean), sigma**2) + (0.0 if extra is None else extra[i])
        variance = np.einsum("bi,bij,bj->b", row, cov, row) + noise
        w = weigh(innovation, variance, noise)
        mean, cov = update(mean, cov, innovation, row, noise, w)
        means.append(mean)
        covs.append(cov)
    return np.stack(means), np.stack(covs)


def ekf(
    z: Array,
    q: float = ACCELERATION,
    sigma: float = SIGMA,
    position_std: float = POSITION_STD,
) -> tuple[Array, Array]:
    """Extended Kalman filter."""
    return run_filter(z, lambda nu, s, r: np.ones_like(nu), q, sigma, position_std)


def standardise(nu: Array, s: Array, r: Array, standardisation: str) -> Array:
    """nu / sqrt(S) for 'innovation', nu / sqrt(R) for 'noise'."""
    if standardisation not in ("innovation", "noise"):
        raise ValueError(standardisation)
    return nu / np.sqrt(s if standardisation == "innovation" else r)


def robust(
    z: Array,
    k0: float = 1.2,
    k1: float = 4.0,
    standardisation: str = "innovation",
    q: float = ACCELERATION,
    sigma: float = SIGMA,
    position_std: float = POSITION_STD,
) -> tuple[Array, Array]:
    """Robust EKF: the IGG-III weight at every step."""

    def weigh(nu: Array, s: Array, r: Array) -> Array:
        return weights.igg3(standardise(nu, s, r, standardisation), k0, k1)

    return run_filter(z, weigh, q, sigma, position_std)


def gated(
    z: Array,
    k0: float = 1.2,
    k1: float = 4.0,
    gate: float = GATE,
    standardisation: str = "innovation",
    q: float = ACCELERATION,
    sigma: float = SIGMA,
    position_std: float = POSITION_STD,
) -> tuple[Array, Array]:
    """Gated robust EKF: plain where nu^2 / S <= gate, the IGG-III weight elsewhere."""

    def weigh(nu: Array, s: Array, r: Array) -> Array:
        w = weights.igg3(standardise(nu, s, r, standardisation), k0, k1)
        return np.where(nu**2 / s <= gate, 1.0, w)

    return run_filter(z, weigh, q, sigma, position_std)


def clairvoyant(
    data: dict[str, Array],
    q: float,
    sigma: float = SIGMA,
    position_std: float = POSITION_STD,
) -> tuple[Array, Array]:
    """EKF told where the faults are and the mean and variance of each one's error."""
    return run_filter(
        data["bearings"],
        lambda nu, s, r: np.ones_like(nu),
        q,
        sigma,
        position_std,
        data["fault_mean"],
        data["fault_variance"],
    )


def rmse(estimate: Array, truth: Array) -> Array:
    """Position error, root mean square over the runs at each k: (T, B, >= 2) -> (T,)."""
    square = ((estimate[..., :2] - truth[..., :2]) ** 2).sum(-1)
    return np.sqrt(square.mean(-1))
