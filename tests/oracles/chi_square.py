"""The chi-square distribution by numerical integration and bisection, plain NumPy."""

import math

import numpy as np

NODES, WEIGHTS = np.polynomial.legendre.leggauss(300)


def survival(x: float, degrees: int) -> float:
    """P(chi-square > x): the density of its root t, integrated from sqrt(x) on."""
    low = math.sqrt(x)
    t = low + 10.0 * (NODES + 1.0)
    log_density = (degrees - 1) * np.log(t) - 0.5 * t**2
    log_density += math.log(2.0) - 0.5 * degrees * math.log(2.0) - math.lgamma(0.5 * degrees)
    return float(10.0 * WEIGHTS @ np.exp(log_density))


def quantile(significance: float, degrees: int) -> float:
    """The x that is exceeded with this probability, by bisection."""
    low, high = 0.0, 1.0
    while survival(high, degrees) > significance:
        high *= 2.0
    for _ in range(100):
        middle = 0.5 * (low + high)
        if survival(middle, degrees) > significance:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
