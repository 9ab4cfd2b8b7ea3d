"""Constant-velocity models in textbook matrix form, plain NumPy; positions then velocities."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def transition(axes: int, dt: float) -> Array:
    """F = [[1, dt], [0, 1]] (x) I."""
    return np.kron(np.array([[1.0, dt], [0.0, 1.0]]), np.eye(axes))


def discrete_noise(spectrum: Array, dt: float) -> Array:
    """Piecewise constant acceleration of covariance C: [dt^2/2; dt] [dt^2/2; dt]^T (x) C."""
    gain = np.array([dt**2 / 2, dt])
    return np.kron(np.outer(gain, gain), spectrum)


def continuous_noise(spectrum: Array, dt: float) -> Array:
    """White acceleration of density C: [[dt^3/3, dt^2/2], [dt^2/2, dt]] (x) C."""
    return np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), spectrum)
