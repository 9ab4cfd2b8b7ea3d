"""What the rows of a log are: rates, gaps, channels that say nothing."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

__all__ = ["Pulse", "Timing", "pulse", "timing"]

Array = NDArray[np.float64]
#: Times the usual interval from which on an interval is a gap.
GAP = 5.0
#: Rows of one value from which on a channel is dead, or stuck.
STUCK = 20


@dataclass(frozen=True)
class Timing:
    """Times of a log, s.

    Attributes:
        rows, seconds: how many, and from first to last.
        interval: median time between rows that increase; gaps: intervals above ``GAP`` of those.
        longest: the longest interval, and the time at which it begins.
        duplicates, reversals: rows at the time of the row before, and before it.
    """

    rows: int
    seconds: float
    interval: float
    gaps: int
    longest: tuple[float, float]
    duplicates: int
    reversals: int


@dataclass(frozen=True)
class Pulse:
    """One channel: how often it speaks.

    Attributes:
        count: measurements; rate: 1/s, by the median interval of its own.
        longest: s, its longest silence, and the time at which that begins.
        low, high: the least and the largest value; stuck: rows of the longest run of one value.
        dead: why it says nothing, "" where it does.
    """

    count: int
    rate: float
    longest: tuple[float, float]
    low: float
    high: float
    stuck: int
    dead: str


def timing(time: Array) -> Timing:
    """Of times (T,) in the order of the file."""
    steps = np.diff(time)
    forward = steps[steps > 0.0]
    usual = float(np.median(forward)) if len(forward) else 0.0
    return Timing(
        rows=len(time),
        seconds=float(time.max() - time.min()),
        interval=usual,
        gaps=int((steps > GAP * usual).sum()) if usual else 0,
        longest=_longest(time),
        duplicates=int((steps == 0.0).sum()),
        reversals=int((steps < 0.0).sum()),
    )


def pulse(time: Array, values: Array) -> Pulse:
    """Of a channel's values (T,), NaN where it was silent."""
    here = ~np.isnan(values)
    own, known = time[here], values[here]
    if not len(known):
        return Pulse(
            count=0,
            rate=0.0,
            longest=(float(np.ptp(time)), float(time[0])),
            low=np.nan,
            high=np.nan,
            stuck=0,
            dead="no value",
        )
    steps = np.diff(own)
    forward = steps[steps > 0.0]
    edges = np.flatnonzero(np.diff(known) != 0.0)
    stuck = int(np.diff(np.concatenate([[-1], edges, [len(known) - 1]])).max())
    dead = ""
    if stuck == len(known) and stuck >= STUCK:
        dead = f"one value in all {stuck} rows"
    elif stuck >= max(STUCK, len(known) // 4):
        dead = f"one value in {stuck} rows on end"
    elif own[-1] < time[0] + 0.9 * (time[-1] - time[0]):
        dead = f"ends at {own[-1]:.6g} s"
    return Pulse(
        count=len(known),
        rate=1.0 / float(np.median(forward)) if len(forward) else 0.0,
        longest=_longest(own),
        low=float(known.min()),
        high=float(known.max()),
        stuck=stuck,
        dead=dead,
    )


def _longest(time: Array) -> tuple[float, float]:
    if len(time) < 2:
        return 0.0, float(time[0])
    at = int(np.argmax(np.diff(time)))
    return float(time[at + 1] - time[at]), float(time[at])
