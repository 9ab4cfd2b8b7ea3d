"""Runs, what values were tuned on, and what they score: names that the tables share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

RUNS = ("los_A1", "los_A2", "nlos_A1", "nlos_A2")
SIMULATED, SQUARED = "simulation", "simulation, squared error alone"
LASTING = "simulation, longer bursts"
HAND, OTHERS = "hand-picked", "the other three"
PAIRS = {"both LOS": RUNS[:2], "both NLOS": RUNS[2:]}
ORDER = (SIMULATED, SQUARED, LASTING, HAND, *RUNS, *PAIRS, OTHERS)
LOSSES = {
    "squared error": {"position": 1.0},
    "likelihood, no truth": {"likelihood": 1.0},
    "squared error and consistency": {"position": 1.0, "consistency": 0.1},
}
BEST = "squared error and consistency"


class Score(NamedTuple):
    """What a set of values does on a run: RMSE in m, NEES per axis."""

    rmse: float
    nees: float


class Errors(NamedTuple):
    """Range errors without the wild ones: standard deviation in m, correlation at 1 s."""

    deviation: float
    correlation: float


#: By what the values were tuned on, and the run that they are run on.
Scores = Mapping[tuple[str, str], Score]


def own(tuned_on: str, run: str) -> bool:
    """Whether a run is among those that values were tuned on."""
    return run in PAIRS.get(tuned_on, (tuned_on,))


def to_hand(scores: Scores, name: str) -> dict[str, float]:
    """RMSE over that of the hand-picked values, by run."""
    return {run: scores[name, run].rmse / scores[HAND, run].rmse for run in RUNS}
