"""Agreement first, then interleaved timing."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Hashable, Mapping, Sequence
from typing import TypeVar

import numpy as np

from difffilter.bench.job import Contender
from difffilter.errors import DifffilterError

__all__ = ["AGREEMENT", "DisagreementError", "agree", "interleaved"]

#: Largest difference of losses, relative to the loss's scale, and of gradients.
AGREEMENT = 1e-9

Key = TypeVar("Key", bound=Hashable)


class DisagreementError(DifffilterError):
    """Contenders that do not compute the same: not worth timing."""


def agree(contenders: Sequence[Contender], steps: int, batch: int) -> None:
    """Run each job once: what compiles has compiled, and all give what the first gives.

    Raises:
        DisagreementError: names the contender and how far it is off.
    """
    first = contenders[0]
    assert first.gradient is not None
    loss, towards = first.gradient()
    for one in contenders:
        found = {}
        if one.takes("value", steps, batch):
            found["loss"] = _apart(one.value(), loss)
        if one.gradient is not None and one.takes("gradient", steps, batch):
            value, gradient = one.gradient()
            found["loss with gradient"] = _apart(value, loss)
            found["gradient"] = _apart(gradient, towards)
        for what, apart in found.items():
            if not apart <= AGREEMENT:
                raise DisagreementError(
                    f"{one.name}: its {what} differs by {apart:.1e} from that of {first.name} "
                    f"(T = {steps}, B = {batch}), expected {AGREEMENT:g} at most"
                )


def _apart(found: object, expected: object) -> float:
    a, b = np.asarray(found), np.asarray(expected)
    if a.shape != b.shape:
        return float("inf")
    return float(np.abs(a - b).max() / max(np.abs(b).max(), 1e-3))


def interleaved(
    calls: Mapping[Key, Callable[[], object]], repetitions: int, seconds: float
) -> dict[Key, float]:
    """Median time of each call, s: in turns, so that a busy moment meets all alike.

    A call that has taken ``seconds`` in all is not repeated any more.
    """
    times: dict[Key, list[float]] = {key: [] for key in calls}
    for _ in range(repetitions):
        for key, call in calls.items():
            if sum(times[key]) > seconds:
                continue
            began = time.perf_counter()
            call()
            times[key].append(time.perf_counter() - began)
    return {key: statistics.median(taken) for key, taken in times.items()}
