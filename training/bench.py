"""Benchmark: what a tuning pass costs, here and in JAX.

The job: value and gradient of the mean squared position error of a robust TDOA filter
(imq weights, 7 channels, 4 states) towards 3 parameters, float64. The JAX peers are the
same filter; losses and gradients must agree before anything is timed. Without JAX
(``pip install -e '.[bench]'``) torch is timed alone. Writes report/bench.

    python training/bench.py [--repetitions N] [--out FOLDER]
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from difffilter import TDOA, ConstantVelocity, Filter, Log, Start, imq, run
from difffilter.report import Report

Array = NDArray[np.float64]
Evaluate = Callable[[Array], tuple[float, Array]]

ROOT = Path(__file__).resolve().parent.parent
DT = 0.5
STATIONS = np.array(
    [
        (0, 0),
        (1600, 0),
        (0, 3500),
        (1600, 3500),
        (800, -400),
        (-500, 1700),
        (2100, 1900),
        (700, 4000),
    ],
    dtype=float,
)
VALUES = {"tdoa.sigma": 3.0, "motion.acceleration": 0.8, "imq.k": 3.0}
AGREEMENT = 1e-9


def problem(steps: int, batch: int) -> Log:
    """Random accelerations, seven range differences with 5 % gross errors, a start."""
    rng = np.random.default_rng(1)
    velocity = rng.normal(0, 8, (batch, 2)) + np.cumsum(
        0.5 * DT * rng.standard_normal((steps, batch, 2)), axis=0
    )
    position = rng.normal((800, 1500), 300, (batch, 2)) + DT * np.cumsum(velocity, axis=0)
    distance = np.linalg.norm(position[:, :, None] - STATIONS, axis=-1)
    z = distance[..., 1:] - distance[..., :1] + 3.0 * rng.standard_normal((steps, batch, 7))
    z += (rng.random(z.shape) < 0.05) * rng.normal(0, 60, z.shape)
    mean = np.concatenate([position[0], velocity[0]], axis=-1) + rng.normal(0, 5, (batch, 4))
    covariance = np.diag([50.0, 50.0, 25.0, 25.0])
    start = Start(torch.tensor(mean), torch.tensor(covariance))
    return Log(
        tuple(f"tdoa_{i}" for i in range(2, 9)),
        torch.tensor(DT * np.arange(1, steps + 1)),
        torch.tensor(z),
        torch.tensor(position),
        ("x", "y"),
        start=Start(start.mean, start.covariance, 0.0),
    )


def library(recipe: Filter, log: Log, threads: int) -> Evaluate:
    """Loss and gradient by this library, values in the order of ``VALUES``."""

    def evaluate(values: Array) -> tuple[float, Array]:
        torch.set_num_threads(threads)
        free = {
            name: torch.tensor(value, dtype=torch.float64).requires_grad_()
            for name, value in zip(VALUES, values, strict=True)
        }
        track = run(recipe, log, free)
        assert log.truth is not None
        loss = (track.mean[..., :2] - log.truth).square().sum(-1).mean()
        gradient = torch.autograd.grad(loss, list(free.values()))
        return loss.item(), torch.stack(gradient).numpy()

    return evaluate


def contenders(log: Log, recipe: Filter) -> dict[str, Evaluate]:
    """This library with one thread and with all, and the JAX peers where JAX is installed."""
    cores = os.cpu_count() or 1
    found = {"difffilter, 1 thread": library(recipe, log, 1)}
    if cores > 1:
        found[f"difffilter, {cores} threads"] = library(recipe, log, cores)
    try:
        import bench_jax
    except ImportError:
        print("JAX is not installed (extra 'bench'): torch alone is timed")
        return found
    assert log.truth is not None
    assert log.start is not None
    assert log.start.covariance is not None
    start = (log.start.mean.numpy(), log.start.covariance.numpy())
    for form in bench_jax.UPDATES:
        peer = bench_jax.peer(form, log.z.numpy(), log.truth.numpy(), start, STATIONS)
        found[f"JAX {bench_jax.version()}, {form}"] = peer
    return found


def agree(found: dict[str, Evaluate], values: Array) -> None:
    """Exit unless every contender gives the same loss and gradient."""
    results = {name: evaluate(values) for name, evaluate in found.items()}
    loss, gradient = next(iter(results.values()))
    for name, (other, other_gradient) in results.items():
        apart = max(
            abs(other - loss) / abs(loss),
            float(np.abs((other_gradient - gradient) / gradient).max()),
        )
        if apart > AGREEMENT:
            sys.exit(f"{name}: loss or gradient differs by {apart:.1e}, expected {AGREEMENT:g}")


def main() -> None:
    """Interleaved repetitions, medians, ratios to the best peer."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--out", type=Path, default=ROOT / "report" / "bench")
    options = parser.parse_args()
    steps, batch = 100, 256
    log = problem(steps, batch)
    recipe = Filter(ConstantVelocity(2), (TDOA(stations=STATIONS.tolist()),), imq)
    values = np.array(list(VALUES.values()))
    found = contenders(log, recipe)
    agree(found, values)
    times: dict[str, list[float]] = {name: [] for name in found}
    for _ in tqdm(range(options.repetitions), desc="bench", delay=2.0):
        for name, evaluate in found.items():
            began = time.perf_counter()
            evaluate(values)
            times[name].append(time.perf_counter() - began)
    median = {name: statistics.median(seconds) for name, seconds in times.items()}
    own = min(value for name, value in median.items() if name.startswith("difffilter"))
    report = Report(
        options.out, "Speed", {"B": batch, "T": steps, "repetitions": options.repetitions}
    )
    report.text(
        f"Value and gradient of the mean squared position error towards {len(values)} parameters: "
        f"TDOA EKF with imq weights, 7 channels, 4 states, B = {batch}, T = {steps}, float64, "
        f"{os.cpu_count()} cores, torch {torch.__version__}. Medians of {options.repetitions} "
        f"interleaved repetitions; losses and gradients agree to {AGREEMENT:g}."
    )
    head = ["engine", "ms", "us per filter step", "ratio: best of difffilter / this"]
    rows = [
        [name, 1e3 * value, 1e6 * value / steps / batch, own / value]
        for name, value in median.items()
    ]
    report.table("value and gradient", head, rows)
    peers = {name: own / value for name, value in median.items() if name.startswith("JAX")}
    if peers:
        held = max(peers.values()) <= 2.0
        report.claim("at most twice the time of JAX, the better of its two forms", held, peers)
    print(report.write().read_text())


if __name__ == "__main__":
    main()
