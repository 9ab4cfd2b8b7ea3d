"""Five channels of two sensors, and a problem on them in textbook form."""

from __future__ import annotations

import numpy as np
from helpers import MOTION, Array, random_spd, tensor, textbook_predict
from oracles import groups as oracle
from torch import Tensor

from difffilter.core.beliefs import Belief
from difffilter.filters.filter import Filter
from difffilter.parameters.parameters import as_number
from difffilter.sensors.sensor import FunctionSensor

NAN = np.nan
_rng = np.random.default_rng(11)
H = _rng.standard_normal((5, 4))
CHANNELS = ("a", "b", "c", "d", "e")
SIGMAS = np.array([0.5, 1.0, 2.0, 1.5, 0.7])
FULL = 4.0 * random_spd(_rng, 3)
#: R of the two sensors: variances alone, one full block, full blocks.
NOISES: dict[str, Array] = {
    "independent": np.diag(SIGMAS**2),
    "mixed": np.diag(SIGMAS**2),
    "full": np.diag(SIGMAS**2),
}
NOISES["mixed"][2:, 2:] = FULL
NOISES["full"][2:, 2:] = FULL
NOISES["full"][:2, :2] = random_spd(_rng, 2)
SCOPES = {
    "sensor": "sensor",
    "all": "all",
    "named": {"first": ("a", "d"), "second": ("c", "e")},
}
GROUPS = {"sensor": [[0, 1], [2, 3, 4]], "all": [[0, 1, 2, 3, 4]], "named": [[0, 3], [2, 4], [1]]}
#: Innovations in sigmas: all there, some missing, a group missing.
INNOVATIONS = {
    "all there": np.array([0.4, -5.0, 1.0, 9.0, -0.3]),
    "some missing": np.array([0.4, NAN, 3.0, -9.0, NAN]),
    "a sensor missing": np.array([NAN, NAN, 3.0, -9.0, 0.5]),
}


def sensor(name: str, channels: slice, noise: str) -> FunctionSensor:
    block = NOISES[noise][channels, channels]
    rows = tensor(H[channels])
    full = bool((block != np.diag(np.diag(block))).any())
    sigma = block.tolist() if full else np.sqrt(np.diag(block)).tolist()
    return FunctionSensor(
        CHANNELS[channels],
        lambda x, inputs, values: (rows @ x.unsqueeze(-1)).squeeze(-1),
        as_number(sigma),
        name=name,
    )


def two_sensors(noise: str = "independent", **options: object) -> Filter:
    """Sensor "pair" with channels a, b and sensor "triple" with c, d, e."""
    sensors = (sensor("pair", slice(0, 2), noise), sensor("triple", slice(2, 5), noise))
    return Filter(MOTION, sensors, **options)  # type: ignore[arg-type]


def problem(state: Belief, sigmas: Array, noise: str) -> tuple[Array, Array, Array, Tensor]:
    """Predicted mean and covariance, innovation of so many sigmas, and the z that has it."""
    mean, cov = textbook_predict(state, 0.5)
    innovation = sigmas * np.sqrt(np.diag(H @ cov @ H.T + NOISES[noise]))
    return mean, cov, innovation, tensor(H @ mean + innovation)


def squares(innovation: Array, covariance: Array, groups: str) -> Array:
    """Squared Mahalanobis distance of each channel's group."""
    variance = np.diag(covariance)
    args = (innovation, covariance, variance, GROUPS[groups], "mahalanobis")
    return np.asarray(oracle.distances(*args) ** 2)
