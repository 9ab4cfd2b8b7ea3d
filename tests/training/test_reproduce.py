"""The joined report: advice and claims of all experiments, and what is judged after each."""

from __future__ import annotations

import json
from argparse import Namespace
from pathlib import Path
from types import ModuleType

import pytest

from difffilter.reports.report import Report
from training import reproduce as module

TRAINING = Path(__file__).parents[2] / "training"


@pytest.fixture(scope="module")
def reproduce() -> ModuleType:
    return module


def test_the_index_begins_with_what_to_do_and_counts_the_claims(
    reproduce: ModuleType, tmp_path: Path
) -> None:
    report = Report(tmp_path / "airport-mlat", "Airport")
    report.claim("one", True, {"a": 1.0})
    report.claim("two", False, {"a": 2.0})
    report.claim("three", None, {"why": "the paper does not say"})
    report.write()
    verdict = Report(tmp_path / "airport-mlat" / "verdict", "Verdict")
    for name, grade in (("first, m-ekf", "keep"), ("second, m-ekf", "adopt")):
        data = {
            "grade": grade, "ratio": 0.9, "ratio_ci95": [0.8, 1.0], "conditions": [],
            "nees_by_direction": {"tuned": {"position": 1.0}}, "page": "report.html",
        }  # fmt: skip
        verdict.verdict(name, f"{grade.capitalize()}: so <much>.", data)
    verdict.write()
    page = reproduce.write_index(tmp_path).read_text(encoding="utf-8")
    assert page.index("second, m-ekf") < page.index("first, m-ekf") < page.index("Experiments")
    assert 'href="airport-mlat/verdict/report.html"' in page
    assert 'href="airport-mlat/report.html"' in page
    assert '<span class="keep">keep</span>' in page
    text = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert "[airport-mlat](airport-mlat/report.md): 1 of 2 claims held, 1 cannot be checked" in text
    assert "  - not held: two" in text
    assert "- uwb-ranges: no report" in text
    data = json.loads((tmp_path / "index.json").read_text(encoding="utf-8"))
    assert list(data["judged"]) == ["first, m-ekf", "second, m-ekf"]
    assert [claim["held"] for claim in data["claims"]["airport-mlat"]] == [True, False, None]


def test_what_an_experiment_froze_is_judged_on_another_seed(
    reproduce: ModuleType, tmp_path: Path
) -> None:
    for name in ("airport-mlat", "uwb-ranges"):
        Report(tmp_path / name, name).write()
    for stem in ("airport-mlat", "airport-mlat-intermittent"):
        (tmp_path / "airport-mlat" / f"{stem}.json").write_text("{}")
    options = Namespace(out=tmp_path, quick=True, seed=3)
    (words,) = reproduce.verdicts("airport-mlat", options)
    # A quick run judges the first one alone.
    assert [Path(word).stem for word in words[:2]] == [
        "airport-mlat-intermittent",
        "--trajectories",
    ]
    assert words[words.index("--seed") + 1] == "8"
    assert words[-1] == str(tmp_path / "airport-mlat" / "verdict")
    assert reproduce.verdicts("weights", options) == []
    assert reproduce.verdicts("manoeuvre-fusion", options) == []  # that experiment left nothing


def test_every_shipped_checkpoint_is_judged(reproduce: ModuleType) -> None:
    judged = {stem for stems in reproduce.VERDICTS.values() for stem in stems}
    shipped = {path.stem for path in (TRAINING.parent / "checkpoints").glob("*.json")}
    assert shipped - judged == {"uwb-ranges"}  # judged by the values without one of the runs
    assert judged <= shipped
