"""Airport surface multilateration: the world and its exact measurement model, plain NumPy.

Arrays carry a leading axis of independent runs. Index 0 of the time axis is the start; the
first measurement that the published filters use is the one of index 1.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LIGHT = 299792458.0
STEP = 0.1
RECEIVERS = np.array(
    [[0, 0], [1600, 0], [0, 1200], [1600, 1200], [0, 2400], [1600, 2400], [0, 3500], [1600, 3500]],
    dtype=float,
)
START = np.array([500.0, 200.0, 0.0, 50.0 / 3.6])
START_STD = 3.0
START_COVARIANCE = np.diag([25.0, 25.0, 4.0, 4.0])


def metres(nanoseconds: float) -> float:
    """Light travel distance of a time in nanoseconds."""
    return nanoseconds * 1e-9 * LIGHT


def range_differences(position: Array) -> Array:
    """r_i - r_1 for i = 2..8: (..., 2) -> (..., 7)."""
    distance = np.linalg.norm(position[..., None, :2] - RECEIVERS, axis=-1)
    return distance[..., 1:] - distance[..., :1]


def range_difference_rows(position: Array) -> Array:
    """Derivative of the range differences towards the position: (..., 2) -> (..., 7, 2)."""
    offset = position[..., None, :2] - RECEIVERS
    unit = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    return unit[..., 1:, :] - unit[..., :1, :]


def noise_covariance(sigma_ns: float, common: bool = False) -> Array:
    """R = (c sigma)^2 I, or (c sigma)^2 (I + 1 1^T) when the reference station's noise is shared.

    With `common`, each station's arrival time has the standard deviation sigma by itself.
    """
    variance = metres(sigma_ns) ** 2
    return variance * (np.eye(7) + (np.ones((7, 7)) if common else 0.0))


def simulate(
    rng: np.random.Generator,
    runs: int,
    steps: int,
    sigma_ns: float = 10.0,
    n_l_ns: float = 0.0,
    p: float = 1.0,
    common: bool = False,
) -> dict[str, Array]:
    """Draw trajectories, range differences, NLOS flags and initial estimates.

    truth (runs, steps+1, 4), measurements (runs, steps+1, 7), nlos (runs, steps+1, 7) of bool,
    initial_mean (runs, 4), initial_covariance (4, 4), acceleration (runs, steps).
    Along-track acceleration is uniform on [-10, 10] and constant within a step:
    y' = y + v dt + a dt^2 / 2, v' = v + a dt. NLOS adds N_L U(0.5, 1) with probability p.
    """
    acceleration = rng.uniform(-10.0, 10.0, (runs, steps))
    truth = np.empty((runs, steps + 1, 4))
    truth[:, 0] = START
    for k in range(steps):
        a = acceleration[:, k]
        truth[:, k + 1] = truth[:, k]
        truth[:, k + 1, 1] += truth[:, k, 3] * STEP + 0.5 * a * STEP**2
        truth[:, k + 1, 3] += a * STEP
    shape = (runs, steps + 1, 7)
    noise = metres(sigma_ns) * rng.standard_normal(shape)
    if common:
        noise = noise + metres(sigma_ns) * rng.standard_normal((runs, steps + 1, 1))
    nlos = rng.random(shape) < (p if n_l_ns > 0 else 0.0)
    delay = metres(n_l_ns) * rng.uniform(0.5, 1.0, shape)
    mean = np.tile(START, (runs, 1))
    mean[:, :2] += START_STD * rng.standard_normal((runs, 2))
    return {
        "truth": truth,
        "measurements": range_differences(truth) + noise + np.where(nlos, delay, 0.0),
        "nlos": nlos,
        "initial_mean": mean,
        "initial_covariance": START_COVARIANCE.copy(),
        "acceleration": acceleration,
    }


def position_errors(means: Array, truth: Array) -> Array:
    """Distance between estimated and true position, any matching leading axes."""
    return np.linalg.norm(means[..., :2] - truth[..., :2], axis=-1)


def nees(means: Array, covariances: Array, truth: Array) -> Array:
    """Normalised squared estimation error e^T P^-1 e of each state estimate."""
    error = (means - truth)[..., None]
    return (np.swapaxes(error, -1, -2) @ np.linalg.solve(covariances, error))[..., 0, 0]
