"""What stands beside the tuned values: filters that are told, and what a guarantee costs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from difffilter import load_scenario
from difffilter.reports.report import Report
from difffilter.scenario.checkpoint import Checkpoint, load
from difffilter.tuning import guards
from difffilter.verdict.evidence import gather
from difffilter.verdict.judge import verdict

pytestmark = pytest.mark.usefixtures("quick_compiler")
SHIPPED = Path(__file__).parents[2] / "checkpoints"
SMALL = {"trajectories": 8, "validation": 8, "test": 4, "batch": 8, "steps": 1}
WORLDS = [{"name": "often", "times": {"faults.nlos.probability": 2.0}}]


def small() -> Checkpoint:
    """Tuned values of a world of few rows, with one world beside it."""
    overrides: dict[str, Any] = {f"tuning.{name}": value for name, value in SMALL.items()}
    overrides |= {"world.steps": 12, "worlds": WORLDS, "tuning.optimiser": "adam"}
    scenario = load_scenario("airport-mlat-intermittent", overrides)
    return replace(load(SHIPPED / "airport-mlat-intermittent.json"), scenario=scenario)


def test_told_tuned_and_the_cost_of_a_guarantee_stand_on_the_page(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(guards, "COUNT", 8)
    report = Report(tmp_path, "Verdict")
    verdict(report, small(), 6, 2, engine="torch", bound=True, guaranteed=True)
    report.write()
    data = json.loads((tmp_path / "report.json").read_text())
    (judged,) = data["judged"].values()
    assert list(judged["told"]) == ["told, published", "told, tuned"]
    (rows,) = (one["rows"] for one in data["comparisons"].values())
    assert [(row["system"], row["values"]) for row in rows][2:] == [
        ("told", "published"), ("told", "tuned")
    ]  # fmt: skip
    assert list(judged["guarantee"]) == ["one world", "family", "family with guards"]
    members = judged["guarantee"]["one world"]
    assert list(members) == ["base", "often"]
    # The values that are judged were tuned on one world: they are not tuned again.
    assert members["base"]["ratio"] == pytest.approx(judged["ratio"], rel=1e-12)
    page = (tmp_path / "report.html").read_text()
    assert "it is the bound" in page


@pytest.mark.parametrize(
    "name", ["airport-mlat-literal-50ns", "airborne-bearing", "airborne-bearing-clean"]
)
def test_values_that_know_one_world_alone_are_not_adopted(name: str) -> None:
    """Shipped values of one world: without its faults, or if the emitter drifts, they fail."""
    found = gather(load(SHIPPED / f"{name}.json"), 24, 5, engine="fused")
    assert found.grade.word != "adopt"
    assert found.grade.terms
