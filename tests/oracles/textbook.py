"""Textbook covariance-form filters for the airport scenario, plain NumPy, vectorised over runs.

Every filter maps a data set of `airport.simulate` to means (runs, steps, 4) and covariances
(runs, steps, 4, 4) at the times 1..steps: predict, then update, no update at time 0.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from . import airport

Array = NDArray[np.float64]
Weight = Callable[[Array], Array]
Update = Callable[[Array, Array, Array, int], tuple[Array, Array]]

ACCELERATION = 5.77
PRIOR_FLOOR = 1e-4


def transpose(matrix: Array) -> Array:
    """Transpose of the last two axes."""
    return np.swapaxes(matrix, -1, -2)


def motion(across: float = ACCELERATION, along: float = ACCELERATION) -> tuple[Array, Array]:
    """Transition F and noise Q = G diag(q_x, q_y)^2 G^T with G rows dt^2/2 and dt (eq. 8)."""
    dt = airport.STEP
    transition = np.eye(4)
    transition[0, 2] = transition[1, 3] = dt
    gain = np.array([[dt**2 / 2, 0.0], [0.0, dt**2 / 2], [dt, 0.0], [0.0, dt]])
    return transition, gain @ np.diag([across**2, along**2]) @ gain.T


def predict(mean: Array, cov: Array, transition: Array, noise: Array) -> tuple[Array, Array]:
    """m = F m, P = F P F^T + Q (eqs. 10, 11)."""
    return mean @ transition.T, transition @ cov @ transition.T + noise


def kalman_update(
    mean: Array, cov: Array, innovation: Array, rows: Array, noise: Array
) -> tuple[Array, Array]:
    """K = P H^T (H P H^T + R)^-1; m + K nu; (I - K H) P (I - K H)^T + K R K^T (eqs. 12-14)."""
    gain = cov @ transpose(rows) @ np.linalg.inv(rows @ cov @ transpose(rows) + noise)
    keep = np.eye(mean.shape[-1]) - gain @ rows
    posterior = keep @ cov @ transpose(keep) + gain @ noise @ transpose(gain)
    return mean + (gain @ innovation[..., None])[..., 0], posterior


def linearise(mean: Array, z: Array, bias: float = 0.0) -> tuple[Array, Array]:
    """Innovation z - h(m) - bias and Jacobian H (runs, 7, 4) at the prediction."""
    rows = np.zeros((*mean.shape[:-1], 7, 4))
    rows[..., :2] = airport.range_difference_rows(mean)
    return z - airport.range_differences(mean) - bias, rows


def regression_update(
    mean: Array,
    cov: Array,
    innovation: Array,
    rows: Array,
    noise: Array,
    weight: Weight,
    all_rows: bool = False,
    mad: bool = False,
    iterations: int = 5,
    floor: float = PRIOR_FLOOR,
) -> tuple[Array, Array, Array]:
    """M-estimation update by explicit whitened regression (eqs. 15-27): mean, covariance, weights.

    [0; nu] = [I; H] d + e with e of covariance blockdiag(P, R) = L L^T and d = x - m. With
    A = L^-1 [I; H] and y = L^-1 [0; nu]: d_0 = (A^T A)^-1 A^T y; then `iterations` times
    v = y - A d, w = weight(v / scale), d = (A^T W A)^-1 A^T W y. scale is 1, or with `mad`
    1.48 median |v - median v| over all rows of the step. Prior rows have w = 1 unless
    `all_rows`, which weighs them too, at least by `floor`. The covariance is (A^T W A)^-1 with
    the last W.
    """
    n, m = mean.shape[-1], innovation.shape[-1]
    joint = np.zeros((*mean.shape[:-1], n + m, n + m))
    joint[..., :n, :n] = cov
    joint[..., n:, n:] = noise
    factor = np.linalg.cholesky(joint)
    identity = np.broadcast_to(np.eye(n), (*mean.shape[:-1], n, n))
    design = np.linalg.solve(factor, np.concatenate([identity, rows], axis=-2))
    target = np.concatenate([np.zeros_like(mean), innovation], axis=-1)[..., None]
    target = np.linalg.solve(factor, target)
    w = np.ones(target.shape[:-1])
    for iteration in range(iterations + 1):
        if iteration > 0:
            residual = (target - design @ shift)[..., 0]  # noqa: F821
            centred = residual - np.median(residual, -1, keepdims=True)
            scale = 1.48 * np.median(np.abs(centred), -1, keepdims=True) if mad else 1.0
            w = weight(residual / scale)
            w[..., :n] = np.maximum(w[..., :n], floor) if all_rows else 1.0
        weighted = transpose(design) * w[..., None, :]
        shift = np.linalg.solve(weighted @ design, weighted @ target)
    return mean + shift[..., 0], np.linalg.inv(weighted @ design), w


def run_filter(
    data: dict[str, Array],
    update: Update,
    across: float = ACCELERATION,
    along: float = ACCELERATION,
) -> tuple[Array, Array]:
    """Predict and update(mean, covariance, z, k) for k = 1..steps."""
    transition, process = motion(across, along)
    mean = data["initial_mean"]
    cov = np.broadcast_to(data["initial_covariance"], (len(mean), 4, 4))
    means, covs = [], []
    for k in range(1, data["measurements"].shape[1]):
        mean, cov = predict(mean, cov, transition, process)
        mean, cov = update(mean, cov, data["measurements"][:, k], k)
        means.append(mean)
        covs.append(cov)
    return np.stack(means, 1), np.stack(covs, 1)


def ekf(
    data: dict[str, Array],
    sigma_ns: float = 10.0,
    common: bool = False,
    bias: float = 0.0,
    across: float = ACCELERATION,
    along: float = ACCELERATION,
) -> tuple[Array, Array]:
    """Extended Kalman filter (eqs. 10-14)."""
    noise = airport.noise_covariance(sigma_ns, common)

    def update(mean: Array, cov: Array, z: Array, _: int) -> tuple[Array, Array]:
        return kalman_update(mean, cov, *linearise(mean, z, bias), noise)

    return run_filter(data, update, across, along)


def m_ekf(
    data: dict[str, Array],
    weight: Weight,
    sigma_ns: float = 10.0,
    all_rows: bool = False,
    mad: bool = False,
    iterations: int = 5,
    floor: float = PRIOR_FLOOR,
    common: bool = False,
    bias: float = 0.0,
    across: float = ACCELERATION,
    along: float = ACCELERATION,
) -> tuple[Array, Array]:
    """M-estimation extended Kalman filter (eqs. 15-27), H linearised once at the prediction."""
    noise = airport.noise_covariance(sigma_ns, common)

    def update(mean: Array, cov: Array, z: Array, _: int) -> tuple[Array, Array]:
        innovation, rows = linearise(mean, z, bias)
        return regression_update(
            mean, cov, innovation, rows, noise, weight, all_rows, mad, iterations, floor
        )[:2]

    return run_filter(data, update, across, along)


def clairvoyant(
    data: dict[str, Array], n_l_ns: float, sigma_ns: float = 10.0, common: bool = False
) -> tuple[Array, Array]:
    """EKF told each channel's NLOS flag b and the delay's mean and variance given b.

    nu = z - h(m) - 0.75 N_L c b and R + diag(b (0.5 N_L c)^2 / 12), the moments of N_L U(0.5, 1).
    """
    noise = airport.noise_covariance(sigma_ns, common)
    delay = airport.metres(n_l_ns)

    def update(mean: Array, cov: Array, z: Array, k: int) -> tuple[Array, Array]:
        flag = data["nlos"][:, k].astype(float)
        extra = (0.5 * delay) ** 2 / 12 * flag[..., None] * np.eye(7)
        innovation, rows = linearise(mean, z)
        return kalman_update(mean, cov, innovation - 0.75 * delay * flag, rows, noise + extra)

    return run_filter(data, update)
