"""The benchmark's peers in JAX: the same filter, written by hand, in two formulations.

Imported only where JAX is installed; it is an extra of this project, not a dependency.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import NDArray

jax.config.update("jax_enable_x64", True)

Array = NDArray[np.float64]
Evaluate = Callable[[Array], tuple[float, Array]]


def innovation(m: Any, p: Any, z: Any, sigma: Any, k: Any, stations: Any) -> tuple[Any, ...]:
    """Innovation, H and the channels' R / w: imq weights of the standardised innovation."""
    apart = m[:2] - stations
    distance = jnp.sqrt(jnp.sum(apart**2, axis=1))
    unit = apart / distance[:, None]
    h = unit[1:] - unit[:1]
    nu = z - (distance[1:] - distance[0])
    s = nu / jnp.sqrt(jnp.einsum("ia,ab,ib->i", h, p[:2, :2], h) + sigma**2)
    return nu, h, sigma**2 * (1.0 + (s / k) ** 2)


def joint(m: Any, p: Any, nu: Any, h: Any, r: Any) -> tuple[Any, Any]:
    """Textbook update with all channels at once: S, K, P - K S K^T."""
    ph = p[:, :2] @ h.T
    s = h @ ph[:2] + jnp.diag(r)
    gain = jax.scipy.linalg.solve(s, ph.T, assume_a="pos").T
    return m + gain @ nu, p - gain @ ph.T


def sequential(m: Any, p: Any, nu: Any, h: Any, r: Any) -> tuple[Any, Any]:
    """One channel after the other, each a scalar update: no matrix is factored."""
    start = m
    for i in range(h.shape[0]):
        g = p[:, :2] @ h[i]
        gain = g / (h[i] @ g[:2] + r[i])
        m = m + gain * (nu[i] - h[i] @ (m - start)[:2])
        p = p - jnp.outer(gain, g)
    return m, p


UPDATES = {"textbook": joint, "sequential": sequential}


def peer(
    form: str, z: Array, truth: Array, start: tuple[Array, Array], stations: Array
) -> Evaluate:
    """Loss and gradient towards (sigma, acceleration, k), compiled: vmap, lax.scan, jit.

    Args:
        form: ``textbook`` or ``sequential``.
        z: (T, B, 7); truth: (T, B, 2); start: mean (B, 4), covariance (4, 4).
        stations: (8, 2).
    """
    dt = 0.5
    transition = jnp.eye(4) + dt * jnp.eye(4, k=2)
    noise = jnp.concatenate([0.5 * dt**2 * jnp.eye(2), dt * jnp.eye(2)])
    update = UPDATES[form]

    def track(values: Any, mean: Any, rows: Any) -> Any:
        sigma, acceleration, k = values
        process = acceleration**2 * noise @ noise.T

        def step(carry: tuple[Any, Any], row: Any) -> tuple[tuple[Any, Any], Any]:
            m, p = carry
            m, p = transition @ m, transition @ p @ transition.T + process
            m, p = update(m, p, *innovation(m, p, row, sigma, k, jnp.asarray(stations)))
            return (m, p), m[:2]

        return jax.lax.scan(step, (mean, jnp.asarray(start[1])), rows)[1]

    def loss(values: Any, z: Any, truth: Any, mean: Any) -> Any:
        estimate = jax.vmap(partial(track, values), in_axes=(0, 1), out_axes=1)(mean, z)
        return jnp.mean(jnp.sum((estimate - truth) ** 2, axis=-1))

    compiled = jax.jit(jax.value_and_grad(loss))
    data = (jnp.asarray(z), jnp.asarray(truth), jnp.asarray(start[0]))

    def evaluate(values: Array) -> tuple[float, Array]:
        value, gradient = compiled(jnp.asarray(values), *data)
        return float(value), np.asarray(gradient)

    return evaluate


def version() -> str:
    """Of JAX."""
    return str(jax.__version__)
