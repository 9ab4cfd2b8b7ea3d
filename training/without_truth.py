"""Tuned without truth, scored with it: each way of asking a log, on recorded and simulated data.

The first way knows the truth and is what the others are held against. Recorded: UWB ranges
(three runs tuned, the fourth scored, four times) and the ferry (2 and 5 tuned, 4 scored).
Simulated: the papers' scenarios, each on trajectories of its own; no loss but the first sees
their truth. Prints RMSE filtered and smoothed and its ratio to the first way's.

Run: ``python -m training.without_truth DATA [CASE ...]``, DATA the folder with ``uwb_ranges`` and
``ferry``.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import difffilter as df

BOTH = {"likelihood": 1.0, "innovation-consistency": 1.0}
#: By name: settings of the tuning; none for the scenario's own loss, with truth.
WAYS: dict[str, dict[str, Any]] = {
    "with truth": {},
    "likelihood": {"loss": {"likelihood": 1.0}},
    "likelihood, consistent": {"loss": BOTH},
    "hide channels": {"loss": BOTH, "hide": "channels"},
    "hide ahead, 1 s": {"loss": BOTH, "hide": "ahead", "ahead": 1.0},
}
UWB = ("los_A1", "los_A2", "nlos_A1", "nlos_A2")
PAPERS = (
    "airport-mlat",
    "airport-mlat-intermittent",
    "airborne-bearing",
    "urban-credibility",
    "manoeuvre-fusion-1",
)
#: Simulated trajectories to tune on, to validate on and to score.
TRAJECTORIES, VALIDATION, TEST, SEED = 128, 64, 200, 7


class Case(NamedTuple):
    """What is tuned on what, and scored on what: logs, or none for simulated trajectories."""

    name: str
    scenario: df.Scenario
    train: list[str] | None = None
    test: list[str] | None = None


def cases(data: Path) -> Iterator[Case]:
    """All of them, the quick ones first."""
    ferry = data / "ferry"
    told = Path("docs/ferry.toml")
    runs = [str(ferry / run) for run in ("s2", "s5")]
    yield Case("ferry", df.load_scenario(told), runs, [str(ferry / "s4")])
    for held in UWB:
        train = [str(data / f"uwb_ranges/{run}.csv") for run in UWB if run != held]
        test = [str(data / f"uwb_ranges/{held}.csv")]
        yield Case(f"uwb {held}", df.load_scenario("uwb-ranges"), train, test)
    for name in PAPERS:
        yield Case(name, df.load_scenario(name))


def scored(case: Case, checkpoint: df.Checkpoint | None) -> tuple[float, float, float]:
    """RMSE filtered and smoothed (NaN where nothing smooths), NEES, on what is held out."""
    system = case.scenario.tuning.system
    options: dict[str, Any] = {"log": case.test, "systems": (system,)}
    options |= {"trajectories": TEST, "seed": SEED}
    values = {"these": checkpoint}
    try:
        found = df.compare(case.scenario, values, smooth=True, **options)
        smoothed = found.row(f"{system} smoothed", "these").rmse
    except df.InputError:
        found = df.compare(case.scenario, values, **options)
        smoothed = float("nan")
    row = found.row(system, "these")
    return row.rmse, smoothed, row.nees_per_state


def main(data: str, wanted: list[str]) -> None:
    """Print a line for each case and way."""
    print("| case | tuned by | RMSE | smoothed | NEES | ratio to with truth |")
    print("|---|---|---|---|---|---|")
    for case in cases(Path(data)):
        if wanted and not any(case.name.startswith(name) for name in wanted):
            continue
        base = None
        for way, settings in WAYS.items():
            sizes = {"trajectories": TRAJECTORIES, "validation": VALIDATION, "test": 2}
            try:
                tuned = df.tune(case.scenario, case.train, settings={**settings, **sizes})
                rmse, smoothed, nees = scored(case, tuned.checkpoint)
            except df.DifffilterError as error:
                print(f"| {case.name} | {way} | {error} | | | |", flush=True)
                continue
            base = rmse if base is None else base
            numbers = [f"{x:.3f}" for x in (rmse, smoothed, nees, rmse / base)]
            print("|", " | ".join([case.name, way, *numbers]), "|", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], sys.argv[2:])
