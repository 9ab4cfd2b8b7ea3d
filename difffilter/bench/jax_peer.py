"""The same robust filter in JAX, written by hand, in two formulations."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

os.environ.setdefault("JAX_PLATFORMS", "cpu")  # before the import: all contenders on the CPU

import jax
import jax.numpy as jnp

from difffilter.bench.job import DT, IMQ, STATIONS, Array, Contender, Task

__all__ = ["Compiled", "contenders", "mean_square"]

jax.config.update("jax_enable_x64", True)


class Compiled:
    """A jitted function and its arguments, compiled when asked, or at the first call."""

    def __init__(self, function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        self._function, self._arguments, self._made = function, arguments, None

    def ready(self) -> None:
        """Compile without running."""
        if self._made is None:
            self._made = jax.jit(self._function).lower(*self._arguments).compile()

    def __call__(self) -> Any:
        self.ready()
        assert self._made is not None
        return jax.block_until_ready(self._made(*self._arguments))


def entry(
    name: str, loss: Callable[..., Any], arguments: tuple[Any, ...], most: tuple[int, int]
) -> Contender:
    """A contender of a loss whose first argument is differentiated."""
    arguments = jax.block_until_ready(tuple(jnp.asarray(x) for x in arguments))
    value = Compiled(loss, arguments)
    both = Compiled(jax.value_and_grad(loss), arguments)

    def gradient() -> tuple[float, Array]:
        found, towards = both()
        return float(found), np.asarray(towards)

    return Contender(name, lambda: float(value()), gradient, both.ready, most)


def contenders(task: Task) -> list[Contender]:
    """Both formulations of the EKF with imq weights: vmap, lax.scan, jit."""
    if task.filter != IMQ:
        return []
    data = (task.point, task.log.z.numpy(), task.truth, task.mean)
    made = []
    for form, update in UPDATES.items():
        loss = partial(_loss, update, jnp.asarray(task.covariance))
        most = (7_000_000 if form == "sequential" else 1_000_000, 1_000_000)
        made.append(entry(f"JAX, {form}", loss, data, most))
    return made


def _loss(update: Any, covariance: Any, values: Any, z: Any, truth: Any, mean: Any) -> Any:
    estimate = jax.vmap(partial(_track, update, covariance, values), (0, 1), 1)(mean, z)
    return mean_square(estimate - truth)


def mean_square(difference: Any) -> Any:
    """log of the mean squared distance, as the loss ``position``."""
    return jnp.log(jnp.mean(jnp.sum(difference**2, axis=-1)))


def _track(update: Any, covariance: Any, values: Any, mean: Any, rows: Any) -> Any:
    sigma, acceleration, k = values
    transition = jnp.eye(4) + DT * jnp.eye(4, k=2)
    noise = jnp.concatenate([0.5 * DT**2 * jnp.eye(2), DT * jnp.eye(2)])
    process = acceleration**2 * noise @ noise.T

    def step(carry: tuple[Any, Any], row: Any) -> tuple[tuple[Any, Any], Any]:
        m, p = carry  # predicted: the start is that of the first row
        m, p = update(m, p, *_innovation(m, p, row, sigma, k))
        p = 0.5 * (p + p.T)  # else rounding grows over a long log
        return (transition @ m, transition @ p @ transition.T + process), m[:2]

    return jax.lax.scan(step, (mean, covariance), rows)[1]


def _innovation(m: Any, p: Any, z: Any, sigma: Any, k: Any) -> tuple[Any, ...]:
    """Innovation, H and the channels' R / w: imq weights of the standardised innovation."""
    apart = m[:2] - jnp.asarray(STATIONS)
    distance = jnp.sqrt(jnp.sum(apart**2, axis=1))
    unit = apart / distance[:, None]
    h = unit[1:] - unit[:1]
    nu = z - (distance[1:] - distance[0])
    s = nu / jnp.sqrt(jnp.einsum("ia,ab,ib->i", h, p[:2, :2], h) + sigma**2)
    return nu, h, sigma**2 * (1.0 + (s / k) ** 2)


def _textbook(m: Any, p: Any, nu: Any, h: Any, r: Any) -> tuple[Any, Any]:
    """All channels at once: S, K, P - K S K^T."""
    ph = p[:, :2] @ h.T
    s = h @ ph[:2] + jnp.diag(r)
    gain = jax.scipy.linalg.solve(s, ph.T, assume_a="pos").T
    return m + gain @ nu, p - gain @ ph.T


def _sequential(m: Any, p: Any, nu: Any, h: Any, r: Any) -> tuple[Any, Any]:
    """One channel after the other, each a scalar update: no matrix is factored."""
    start = m
    for i in range(h.shape[0]):
        g = p[:, :2] @ h[i]
        gain = g / (h[i] @ g[:2] + r[i])
        m = m + gain * (nu[i] - h[i] @ (m - start)[:2])
        p = p - jnp.outer(gain, g)
    return m, p


UPDATES = {"textbook": _textbook, "sequential": _sequential}
