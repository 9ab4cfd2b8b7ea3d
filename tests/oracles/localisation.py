"""Single-epoch positioning from range differences, and the filter on its solution, plain NumPy."""

import numpy as np
from numpy.typing import NDArray

from . import airport, textbook
from .textbook import transpose

Array = NDArray[np.float64]

RANGE_ACCELERATION = 2 * textbook.ACCELERATION  # |d(r_i - r_1)/d position| is at most 2


def taylor_ls(
    z: Array, start: Array, noise: Array, weights: Array | None = None, iterations: int = 10
) -> tuple[Array, Array]:
    """Taylor-series (Gauss-Newton) least squares: position (..., 2) and covariance (..., 2, 2).

    p <- p + (H^T M H)^-1 H^T M (z - h(p)) from `start`, with M = R^-1, or with row weights w
    M = diag(sqrt w) R^-1 diag(sqrt w). The covariance is (H^T M H)^-1 at the last linearisation.
    """
    information = np.linalg.inv(noise)
    if weights is not None:
        root = np.sqrt(weights)
        information = root[..., :, None] * information * root[..., None, :]
    position = np.broadcast_to(start, (*z.shape[:-1], 2)).copy()
    for _ in range(iterations):
        rows = airport.range_difference_rows(position)
        residual = (z - airport.range_differences(position))[..., None]
        normal = transpose(rows) @ information @ rows
        position += np.linalg.solve(normal, transpose(rows) @ information @ residual)[..., 0]
    return position, np.linalg.inv(normal)


def chan_ls(
    z: Array, noise: Array, iterations: int = 2, tangent: bool = False
) -> tuple[Array, Array]:
    """Chan's two-step closed form in the plane: position (..., 2) and covariance (..., 2, 2).

    Step 1, coordinates relative to receiver 1, s_i the receivers, d_i = r_i - r_1, u = (x, y, r_1):
    (d_i^2 - |s_i|^2) / 2 = -(s_i, d_i) u, with error covariance B R B, B = diag(r_i); B = I at
    first, then `iterations` times from the last u. C = cov(u) = (G^T (B R B)^-1 G)^-1.
    Step 2, Chan's regression of (x^2, y^2, r_1^2) on (X^2, Y^2) with G' = [1 0; 0 1; 1 1] and
    covariance 4 B' C B', B' = diag(x, y, r_1), each row divided by 2 B' first, so that it is
    well conditioned where x or y is small: with X^2 = x^2 + 2 x dx and Y^2 = y^2 + 2 y dy
        [0; 0; (r_1^2 - x^2 - y^2) / (2 r_1)] = [1 0; 0 1; x/r_1 y/r_1] [dx; dy] + e, cov(e) = C.
    X = sign(x) sqrt(max(x^2 + 2 x dx, 0)), the sign from step 1; with `tangent` X = x + dx, which
    differs by dx^2 / (2 x). The covariance is that of (dx, dy).
    """
    stations = airport.RECEIVERS[1:] - airport.RECEIVERS[0]
    design = -np.concatenate(
        [np.broadcast_to(stations, (*z.shape[:-1], 7, 2)), z[..., None]], axis=-1
    )
    target = 0.5 * (z**2 - (stations**2).sum(-1))[..., None]
    covariance = np.broadcast_to(noise, (*z.shape[:-1], 7, 7))
    for iteration in range(iterations + 1):
        information = np.linalg.inv(covariance)
        normal = transpose(design) @ information @ design
        u = np.linalg.solve(normal, transpose(design) @ information @ target)[..., 0]
        if iteration < iterations:
            distance = np.linalg.norm(u[..., None, :2] - stations, axis=-1)
            covariance = distance[..., :, None] * noise * distance[..., None, :]
    x, r1 = u[..., :2], u[..., 2]
    mismatch = np.zeros((*u.shape, 1))
    mismatch[..., 2, 0] = (r1**2 - (x**2).sum(-1)) / (2 * r1)
    second = np.zeros((*u.shape, 2))
    second[..., :2, :] = np.eye(2)
    second[..., 2, :] = x / r1[..., None]
    constrained = transpose(second) @ normal @ second
    delta = np.linalg.solve(constrained, transpose(second) @ normal @ mismatch)[..., 0]
    solution = x + delta
    if not tangent:
        solution = np.sign(x) * np.sqrt(np.maximum(x**2 + 2 * x * delta, 0.0))
    return solution + airport.RECEIVERS[0], np.linalg.inv(constrained)


def smooth_range_differences(
    data: dict[str, Array], sigma_ns: float, acceleration: float = RANGE_ACCELERATION
) -> tuple[Array, Array]:
    """Each range difference filtered by itself: values and variances (runs, steps, 7).

    State [d, d'], constant velocity with Q = g g^T q^2, g = [dt^2/2, dt]; start h(m_0), H v_0
    with the variances of H P_0 H^T (cross terms between position and velocity are zero).
    """
    dt = airport.STEP
    transition, gain = np.array([[1.0, dt], [0.0, 1.0]]), np.array([dt**2 / 2, dt])
    process = acceleration**2 * np.outer(gain, gain)
    noise = np.full((1, 1), airport.metres(sigma_ns) ** 2)
    pick = np.array([[1.0, 0.0]])
    start, start_cov = data["initial_mean"], data["initial_covariance"]
    rows = airport.range_difference_rows(start)
    rate = (rows @ start[:, 2:, None])[..., 0]
    mean = np.stack([airport.range_differences(start), rate], -1)
    cov = np.zeros((*mean.shape, 2))
    for i, block in enumerate((start_cov[:2, :2], start_cov[2:, 2:])):
        cov[..., i, i] = np.einsum("...ij,jk,...ik->...i", rows, block, rows)
    values, variances = [], []
    for k in range(1, data["measurements"].shape[1]):
        mean, cov = textbook.predict(mean, cov, transition, process)
        innovation = data["measurements"][:, k, :, None] - mean[..., :1]
        mean, cov = textbook.kalman_update(mean, cov, innovation, pick, noise)
        values.append(mean[..., 0])
        variances.append(cov[..., 0, 0])
    return np.stack(values, 1), np.stack(variances, 1)


def chan_ekf(
    data: dict[str, Array], sigma_ns: float = 10.0, acceleration: float = RANGE_ACCELERATION
) -> tuple[Array, Array]:
    """Smoothed range differences, Chan on them, then a Kalman filter on Chan's positions.

    Measurement matrix [I 0] and Chan's covariance, computed from the smoothed variances. The
    errors of the smoothed values are correlated in time; as in the paper that is ignored.
    """
    values, variances = smooth_range_differences(data, sigma_ns, acceleration)
    positions, noise = chan_ls(values, variances[..., None] * np.eye(7))
    pick = np.eye(2, 4)

    def update(mean: Array, cov: Array, _: Array, k: int) -> tuple[Array, Array]:
        innovation = positions[:, k - 1] - mean[:, :2]
        return textbook.kalman_update(mean, cov, innovation, pick, noise[:, k - 1])

    return textbook.run_filter(data, update)
