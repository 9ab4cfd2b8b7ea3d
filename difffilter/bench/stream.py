"""Time of one step on a live stream, from Python; and of a row that is replayed."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable
from typing import Any

import torch

from difffilter.bench.job import DT, FUSED, IMQ, PLAIN, TORCH, problem, task
from difffilter.running.tracker import Tracker

__all__ = ["FED", "READ", "latencies"]

LENGTH = 200
#: The compiled step with its belief read after each, and all rows in one call.
READ, FED = f"{FUSED}, belief read", f"{FUSED}, feed"


def latencies(peers: Iterable[str], repetitions: int) -> dict[tuple[str, str], float]:
    """us per step by (contender, filter): medians over interleaved runs through a log."""
    log = problem(LENGTH, 1)
    fed = _tracker(IMQ, "fused")
    made: dict[tuple[str, str], Callable[[], Callable[[Any], object]]] = {
        (FUSED, IMQ): _stepping(_tracker(IMQ, "fused")),
        (READ, IMQ): _stepping(_tracker(IMQ, "fused"), read=True),
        (FUSED, PLAIN): _stepping(_tracker(PLAIN, "fused")),
        (TORCH, IMQ): _stepping(_tracker(IMQ, "torch")),
    }
    rows: dict[str, list[Any]] = {"": log.z[:, 0].tolist()}
    if "filterpy" in peers:
        from difffilter.bench import filterpy_peer

        plain = task(PLAIN, log)
        made[filterpy_peer.NAME, PLAIN] = lambda: filterpy_peer.stream(plain, 0)[0]
        rows[filterpy_peer.NAME] = list(log.z[:, 0].numpy())
    times: dict[tuple[str, str], list[float]] = {key: [] for key in (*made, (FED, IMQ))}
    rows_fed, dt = log.z[:, 0], torch.full((LENGTH,), DT, dtype=torch.float64)
    fed().feed(rows_fed, dt)  # compiled
    for _ in range(repetitions):
        for key, make in made.items():
            step, given = make(), rows.get(key[0], rows[""])
            step(given[0])
            began = time.perf_counter()
            for row in given[1:]:
                step(row)
            times[key].append((time.perf_counter() - began) / (len(given) - 1))
        tracker = fed()
        began = time.perf_counter()
        tracker.feed(rows_fed, dt)
        times[FED, IMQ].append((time.perf_counter() - began) / LENGTH)
    return {key: 1e6 * statistics.median(taken) for key, taken in times.items()}


def _tracker(filter: str, engine: str) -> Callable[[], Tracker]:
    one = task(filter, problem(LENGTH, 1))
    assert one.log.start is not None
    mean, covariance = one.log.start.mean[0], one.log.start.covariance
    assert covariance is not None
    return lambda: Tracker(one.recipe, mean, covariance, dict(one.values), engine=engine)


def _stepping(
    make: Callable[[], Tracker], read: bool = False
) -> Callable[[], Callable[[Any], object]]:
    def start() -> Callable[[Any], object]:
        tracker = make()
        if read:
            return lambda row: (tracker.step(row, DT), tracker.belief)
        return lambda row: tracker.step(row, DT)

    return start
