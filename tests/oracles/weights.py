"""Hard weight functions of a standardised residual s, plain NumPy.

Each takes an array of any shape and returns weights in [0, 1] of the same shape.
"""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def plain(s: Array) -> Array:
    """Weight 1 everywhere."""
    return np.ones_like(s)


def huber(s: Array, k: float = 1.345) -> Array:
    """min(1, k / |s|)."""
    return k / np.maximum(np.abs(s), k)


def igg3(s: Array, k0: float = 1.2, k1: float = 4.0) -> Array:
    """1 up to k0, (k0/|s|) ((k1-|s|)/(k1-k0))^2 up to k1, then 0."""
    size = np.abs(s)
    middle = k0 / np.maximum(size, k0) * ((k1 - size) / (k1 - k0)) ** 2
    return np.where(size <= k0, 1.0, np.where(size <= k1, middle, 0.0))


def tanh_slope(a: float, b: float) -> float:
    """The c > 0 that solves a = c tanh(c (b - a) / 2), by bisection."""
    low, high = 0.0, a + 2.0 / (b - a) + 1.0
    while high * np.tanh(high * (b - a) / 2) < a:
        high *= 2.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        if middle * np.tanh(middle * (b - a) / 2) < a:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def tanh(s: Array, a: float = 1.5, b: float = 4.0) -> Array:
    """psi(s)/s: 1 for |s| < a, c tanh(c (b-|s|)/2)/|s| for a <= |s| < b, 0 beyond (eq. 25)."""
    size = np.abs(s)
    c = tanh_slope(a, b)
    middle = c * np.tanh(c * (b - size) / 2) / np.maximum(size, a)
    return np.where(size < a, 1.0, np.where(size < b, middle, 0.0))


def imq(s: Array, k: float = 2.0) -> Array:
    """1 / (1 + (s/k)^2), the squared inverse multi-quadric."""
    return 1.0 / (1.0 + (s / k) ** 2)


def danish(s: Array, k: float = 2.0) -> Array:
    """1 up to k, exp(1 - (s/k)^2) beyond."""
    return np.where(np.abs(s) <= k, 1.0, np.exp(1.0 - np.maximum(np.abs(s) / k, 1.0) ** 2))


def tukey(s: Array, k: float = 4.685) -> Array:
    """(1 - (s/k)^2)^2 below k, 0 beyond."""
    return np.where(np.abs(s) < k, (1.0 - (s / k) ** 2) ** 2, 0.0)


def cauchy(s: Array, k: float = 2.385) -> Array:
    """1 / (1 + (s/k)^2)."""
    return 1.0 / (1.0 + (s / k) ** 2)


def welsch(s: Array, k: float = 2.985) -> Array:
    """exp(-(s/k)^2 / 2)."""
    return np.exp(-((s / k) ** 2) / 2.0)


def student_t(s: Array, nu: float = 4.0) -> Array:
    """(nu + 1) / (nu + s^2), at most 1."""
    return np.minimum((nu + 1.0) / (nu + s**2), 1.0)


def barron(s: Array, alpha: float = 0.0, k: float = 1.686) -> Array:
    """(s^2 / (k^2 |alpha - 2|) + 1)^(alpha/2 - 1) and its limits at alpha = 2, 0 and -inf."""
    x = (s / k) ** 2
    if alpha == 2.0:
        return np.ones_like(x)
    if alpha == 0.0:
        return 2.0 / (x + 2.0)
    if alpha == -np.inf:
        return np.exp(-0.5 * x)
    return np.exp((0.5 * alpha - 1.0) * np.log1p(x / abs(alpha - 2.0)))


def chi_square_gate(s: Array, threshold: float = 7.879) -> Array:
    """1 where s^2 <= threshold (one degree of freedom), else 0."""
    return (s**2 <= threshold).astype(float)
