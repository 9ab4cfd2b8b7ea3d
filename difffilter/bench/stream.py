"""Time of one step on a live stream, from Python."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Iterable
from typing import Any

from difffilter.bench.job import DT, FUSED, IMQ, PLAIN, TORCH, problem, task
from difffilter.running.tracker import Tracker

__all__ = ["latencies"]

LENGTH = 200


def latencies(peers: Iterable[str], repetitions: int) -> dict[tuple[str, str], float]:
    """us per step by (contender, filter): medians over interleaved runs through a log."""
    log = problem(LENGTH, 1)
    made: dict[tuple[str, str], Callable[[], Callable[[Any], object]]] = {
        (FUSED, IMQ): _tracker(IMQ, "fused"),
        (FUSED, PLAIN): _tracker(PLAIN, "fused"),
        (TORCH, IMQ): _tracker(IMQ, "torch"),
    }
    rows: dict[str, list[Any]] = {"": log.z[:, 0].tolist()}
    if "filterpy" in peers:
        from difffilter.bench import filterpy_peer

        plain = task(PLAIN, log)
        made[filterpy_peer.NAME, PLAIN] = lambda: filterpy_peer.stream(plain, 0)[0]
        rows[filterpy_peer.NAME] = list(log.z[:, 0].numpy())
    times: dict[tuple[str, str], list[float]] = {key: [] for key in made}
    for _ in range(repetitions):
        for key, make in made.items():
            step, given = make(), rows.get(key[0], rows[""])
            step(given[0])
            began = time.perf_counter()
            for row in given[1:]:
                step(row)
            times[key].append((time.perf_counter() - began) / (len(given) - 1))
    return {key: 1e6 * statistics.median(taken) for key, taken in times.items()}


def _tracker(filter: str, engine: str) -> Callable[[], Callable[[Any], object]]:
    one = task(filter, problem(LENGTH, 1))
    assert one.log.start is not None
    mean, covariance = one.log.start.mean[0], one.log.start.covariance
    assert covariance is not None

    def make() -> Callable[[Any], object]:
        tracker = Tracker(one.recipe, mean, covariance, dict(one.values), engine=engine)
        return lambda row: tracker.step(row, DT)

    return make
