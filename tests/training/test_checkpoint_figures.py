"""The shipped checkpoints: each gives the held-out errors that it records.

Engines add in other orders, and compilers contract sums: both engines agree with the recorded
figure, which the compiled one made, to ``TOLERANCE`` of it.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

import difffilter as df
from difffilter.engine.build import compiler

ROOT = Path(__file__).parents[2]
RECORDINGS = ROOT.parent / "shared" / "data" / "uwb_ranges"
PATHS = sorted((ROOT / "checkpoints").glob("*.json"))
TOLERANCE = 1e-8
ENGINES = [
    "torch",
    pytest.param("fused", marks=pytest.mark.skipif(compiler() is None, reason="no C compiler")),
]


@pytest.mark.parametrize("engine", ENGINES)
@pytest.mark.parametrize(
    "path", [p for p in PATHS if p.stem != "uwb-ranges"], ids=lambda path: path.stem
)
def test_a_checkpoint_gives_the_held_out_errors_that_it_records(path: Path, engine: str) -> None:
    checkpoint = df.load(path)
    result: Mapping[str, Any] = checkpoint.result
    recorded = {(row["system"], row["values"]): row for row in result["rows"]}
    table = df.compare(
        checkpoint.scenario,
        {"published": None, "tuned": checkpoint},
        result["trajectories"],
        result["seed"],
        systems=(checkpoint.system,),
        engine=engine,
    )
    for values in ("published", "tuned"):
        found, expected = table.row(checkpoint.system, values), recorded[checkpoint.system, values]
        assert found.rmse == pytest.approx(expected["rmse"], rel=TOLERANCE)
        assert found.nees_per_state == pytest.approx(expected["nees_per_state"], rel=TOLERANCE)


@pytest.mark.skipif(not RECORDINGS.is_dir(), reason=f"no recordings in {RECORDINGS}")
@pytest.mark.parametrize("engine", ENGINES)
def test_values_tuned_on_three_recorded_runs_give_the_fourth_the_recorded_error(
    engine: str,
) -> None:
    checkpoint = df.load(ROOT / "checkpoints" / "uwb-ranges.json")
    filter, rotations = checkpoint.published_filter, checkpoint.result["leave_one_run_out"]
    assert len(rotations) == 4
    for run, recorded in rotations.items():
        log = df.load_logs(checkpoint.scenario, [RECORDINGS / f"{run}.csv"])
        values = {
            name: torch.tensor(value, dtype=torch.float64)
            for name, value in recorded["values"].items()
        }
        ready = df.started(checkpoint.scenario, filter, log, values)
        with torch.no_grad():
            track = df.run(filter, ready, values, engine=engine)
        error = float(df.rmse(log, track, checkpoint.scenario.score))
        assert error == pytest.approx(recorded["rmse"], rel=TOLERANCE)
