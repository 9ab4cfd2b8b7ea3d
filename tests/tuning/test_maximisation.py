"""Expectation-maximisation of Q and R against a general optimiser of an independent likelihood."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import tensor
from numpy.typing import NDArray

import difffilter as df
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.sensors.builtin import Position
from difffilter.tuning.maximisation import expectation_maximisation

D = torch.float64
NAMES = ("motion.acceleration", "a.sigma", "b.sigma")


def recipe() -> Filter:
    sensors = tuple(Position(name=n, axes=1, sigma=1.0) for n in "ab")
    return Filter(ConstantVelocity(1, noise_kind="discrete", acceleration=1.0), sensors)


def simulated(rows: int = 60) -> Log:
    """Two sensors of 0.4 and 1.5 on a motion of 0.6, uneven times, some missing."""
    rng = np.random.default_rng(8)
    time = np.cumsum(rng.uniform(0.2, 1.0, rows))
    x, z = np.zeros(2), []
    for dt in np.diff(time, prepend=0.0):
        x = np.array([x[0] + dt * x[1], x[1]]) + 0.6 * rng.normal() * np.array([dt**2 / 2, dt])
        z.append([x[0] + 0.4 * rng.normal(), x[0] + 1.5 * rng.normal()])
    measured = np.array(z)
    measured[rng.random(measured.shape) < 0.15] = np.nan
    start = Start(torch.zeros(2, dtype=D), torch.eye(2, dtype=D), time=0.0)
    return Log(("a_1", "b_1"), tensor(time), tensor(measured), start=start)


def likelihood(log: Log, sigmas: NDArray[np.float64]) -> float:
    """Of a textbook filter, scalar by scalar."""
    m, p, total, before = np.zeros(2), np.eye(2), 0.0, 0.0
    for time, z in zip(log.time.numpy(), log.z.numpy(), strict=True):
        dt, before = time - before, time
        f, g = np.array([[1.0, dt], [0.0, 1.0]]), sigmas[0] * np.array([dt**2 / 2, dt])
        m, p = f @ m, f @ p @ f.T + np.outer(g, g)
        for value, sigma in zip(z, sigmas[1:], strict=True):
            if np.isfinite(value):
                s = p[0, 0] + sigma**2
                total -= 0.5 * (np.log(2 * np.pi * s) + (value - m[0]) ** 2 / s)
                gain = p[:, 0] / s
                m, p = m + gain * (value - m[0]), p - np.outer(gain, p[0])
    return float(total)


def test_reaches_the_maximum_of_the_likelihood() -> None:
    optimise = pytest.importorskip("scipy.optimize")
    log = simulated()

    def unlikely(x: NDArray[np.float64]) -> float:
        return -likelihood(log, np.exp(x))

    best = optimise.minimize(unlikely, np.log([0.6, 0.4, 1.5]), method="BFGS")
    found = expectation_maximisation(recipe(), log, tuned=NAMES)
    sigmas = np.array([float(found.values[n]) for n in NAMES])
    assert found.converged
    assert abs(found.log_likelihood / likelihood(log, sigmas) - 1.0) < 1e-9
    assert abs(found.log_likelihood / -best.fun - 1.0) < 1e-6
    assert np.abs(sigmas / np.exp(best.x) - 1.0).max() < 1e-4
    assert np.abs(np.log(sigmas / [0.6, 0.4, 1.5])).max() < 0.4


def test_trajectories_add_up() -> None:
    """Two copies of a log tell what one does; a column per axis, scaled together."""
    log = simulated(20)
    assert log.start is not None
    twice = replace(log, z=log.z.unsqueeze(1).expand(-1, 2, -1))
    one, two = (expectation_maximisation(recipe(), x, tuned=NAMES, steps=2) for x in (log, twice))
    assert two.log_likelihood == pytest.approx(2.0 * one.log_likelihood, rel=1e-9)
    assert float(two.values["a.sigma"]) == pytest.approx(float(one.values["a.sigma"]), rel=1e-6)


def test_what_cannot_be_maximised_is_told() -> None:
    log = simulated(5)
    with pytest.raises(InputError, match="weighs or gates"):
        expectation_maximisation(replace(recipe(), weight=df.huber), log, tuned=NAMES)
    with pytest.raises(InputError, match="no tuned parameter"):
        expectation_maximisation(recipe(), log)
    with pytest.raises(InputError, match=r"found c\.sigma"):
        expectation_maximisation(recipe(), log, tuned=("c.sigma",))
