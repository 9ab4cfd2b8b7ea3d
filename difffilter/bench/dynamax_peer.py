"""The plain filter by dynamax's extended_kalman_filter, which has no weights."""

from __future__ import annotations

from functools import partial
from typing import Any

from difffilter.bench.jax_peer import entry, mean_square  # before jax: chooses the CPU
from difffilter.bench.job import DT, PLAIN, STATIONS, Contender, Task

# isort: split
import jax
import jax.numpy as jnp
from dynamax.nonlinear_gaussian_ssm import ParamsNLGSSM, extended_kalman_filter

__all__ = ["contenders"]


def contenders(task: Task) -> list[Contender]:
    """vmap over trajectories, jit."""
    if task.filter != PLAIN:
        return []
    data = (task.point, task.log.z.numpy(), task.truth, task.mean)
    loss = partial(_loss, jnp.asarray(task.covariance))
    return [entry("dynamax", loss, data, (500_000, 500_000))]


def _differences(state: Any) -> Any:
    distance = jnp.sqrt(jnp.sum((state[:2] - jnp.asarray(STATIONS)) ** 2, axis=1))
    return distance[1:] - distance[0]


def _loss(covariance: Any, values: Any, z: Any, truth: Any, mean: Any) -> Any:
    sigma, acceleration = values
    transition = jnp.eye(4) + DT * jnp.eye(4, k=2)
    noise = jnp.concatenate([0.5 * DT**2 * jnp.eye(2), DT * jnp.eye(2)])
    process = acceleration**2 * noise @ noise.T

    def track(mean: Any, rows: Any) -> Any:
        model = ParamsNLGSSM(
            initial_mean=mean,
            initial_covariance=covariance,
            dynamics_function=lambda state: transition @ state,
            dynamics_covariance=process,
            emission_function=_differences,
            emission_covariance=sigma**2 * jnp.eye(7),
        )
        found = extended_kalman_filter(model, rows, output_fields=["filtered_means"])
        return found.filtered_means[:, :2]

    return mean_square(jax.vmap(track, (0, 1), 1)(mean, z) - truth)
