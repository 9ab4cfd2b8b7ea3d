"""How much is measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

__all__ = ["FULL", "QUICK", "Sizes"]


@dataclass(frozen=True)
class Sizes:
    """What a run measures.

    Attributes:
        speed: (T, B) of the timed jobs.
        memory: two T, and the B that they share; remembering: of how many contenders.
        repetitions: at most; seconds: that one contender's repetitions of a job may take.
        compiled: filters whose compilation is timed, of the benchmark or SCENARIO/SYSTEM.
        patience: s after which a compiler is ended.
        tuning: settings of the airport's tuning; None to leave it out.
    """

    speed: tuple[tuple[int, int], ...]
    memory: tuple[int, int, int]
    remembering: int
    repetitions: int
    seconds: float
    compiled: tuple[str, ...]
    patience: float
    tuning: dict[str, Any] | None


FULL = Sizes(
    speed=(
        (100, 1),
        (100, 256),
        (100, 4096),
        (100, 65536),
        (10_000, 1),
        (10_000, 16),
        (10_000, 64),
    ),
    memory=(100, 10_000, 16),
    remembering=5,
    repetitions=15,
    seconds=3.0,
    compiled=("EKF, imq weights", "airport-mlat/m-ekf-all-rows", "airport-mlat/m-ekf-mad"),
    patience=120.0,
    tuning={"trajectories": 1000},
)
QUICK = Sizes(
    speed=((20, 64),),
    memory=(20, 200, 8),
    remembering=2,
    repetitions=3,
    seconds=0.3,
    compiled=("EKF, imq weights",),
    patience=60.0,
    tuning=None,
)
