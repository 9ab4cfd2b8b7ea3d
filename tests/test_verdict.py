"""The verdict: what reverting is worth, conditions, the advice, and the command's page."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from helpers import tensor

from difffilter import Filter, load_scenario, run, simulate, started
from difffilter.checkpoint import Checkpoint, save
from difffilter.compare import Comparison, Row
from difffilter.metrics import position_error, scored_rows
from difffilter.report import Report
from difffilter.stress import CONDITIONS, Stressed, stress
from difffilter.verdict import Change, changes
from difffilter.verdict_report import advice, verdict

SCENARIO = load_scenario("gate-lockout", {"world.steps": 40})
CLEAN = SCENARIO.with_overrides({"tuning.system": "gated"})


def tuned(**values: float) -> Checkpoint:
    """A checkpoint of ``gated`` with some values changed."""
    filter = CLEAN.system("gated")
    assert isinstance(filter, Filter)
    changed = {name.replace("__", "."): tensor(value) for name, value in values.items()}
    training = {"standard_errors": {"position.sigma": 0.5}}
    return Checkpoint(CLEAN, "gated", filter.published() | changed, None, training)


LOG = simulate(CLEAN, 12, 4, "test")


def rmse_of(values: dict[str, torch.Tensor]) -> float:
    filter = CLEAN.system("gated")
    assert isinstance(filter, Filter)
    log = started(CLEAN, filter, LOG, values)
    track = run(filter, log, values)
    rows = scored_rows(LOG, track, CLEAN.score)
    return float(position_error(LOG, track)[rows].mean().sqrt())


def test_reverting_one_value_leaves_the_others_tuned() -> None:
    checkpoint = tuned(position__sigma=25.0, motion__acceleration=3.0)
    found = {change.name: change for change in changes(checkpoint, LOG)}
    values = dict(checkpoint.values)
    published = checkpoint.published_filter.published()
    for name in ("position.sigma", "motion.acceleration"):
        expected = rmse_of({**values, name: published[name]}) / rmse_of(values)
        assert found[name].ratio[0] == pytest.approx(expected, rel=1e-9)
        low, high = found[name].ratio[1:]
        assert low <= found[name].ratio[0] <= high
    entry, before, after, error = found["position.sigma"].entries[0]
    assert (entry, before, after, error) == ("position.sigma", 10.0, 25.0, 0.5)
    assert found["position.sigma"].sigmas() == [30.0]
    assert found["motion.acceleration"].sigmas() == [None]
    # What was not changed costs nothing to take back.
    assert found["gate.threshold"].ratio[0] == 1.0


def test_every_condition_has_the_log_as_it_is_among_its_levels() -> None:
    checkpoint = tuned(motion__acceleration=3.0)
    filter = checkpoint.published_filter
    found = list(stress(CLEAN, filter, LOG, checkpoint.values))
    assert [(x.condition, x.level) for x in found] == [
        (name, level) for name, (_, levels) in CONDITIONS.items() for level in levels
    ]
    same = [x for x in found if x.level == (1.0 if x.condition == "noise" else 0.0)]
    assert len(same) == len(CONDITIONS)
    for x in same:
        assert x.published == pytest.approx(rmse_of(filter.published()), rel=1e-9)
        assert x.tuned == pytest.approx(rmse_of(dict(checkpoint.values)), rel=1e-9)
        assert x.ratio[0] == pytest.approx(x.tuned / x.published, rel=1e-9)
    noise = [x.published for x in found if x.condition == "noise"]
    assert noise == sorted(noise)
    assert noise[-1] > noise[0]


def row(values: str, ratio: tuple[float, float, float], nees: float = 1.1) -> Row:
    return Row("gated", values, 2.0, (1.9, 2.1), 2.0, ratio[0], ratio[1:], nees, 1.0, 1.0, {}, {})


def told(ratio: tuple[float, float, float], worse: float = 1.0, nees: float = 1.1) -> str:
    rows = (row("published", (1.0, 1.0, 1.0)), row("tuned", ratio, nees))
    table = Comparison("gate-lockout", 10, 1, "gated published", rows)
    change = Change("gate.threshold", "1", (), (1.0, 0.99, 1.01), 1.0, True)
    under = Stressed("noise", 3.0, 1.0, worse, (1.0, 1.0), (worse, worse - 0.01, worse + 0.01))
    return advice(table, "gated", [change], [under])


def test_the_advice_follows_from_the_numbers() -> None:
    assert told((0.9, 0.85, 0.95)).startswith("Adopt the tuned values.")
    careful = told((0.9, 0.85, 0.95), worse=1.2)
    assert careful.startswith("Adopt with care.")
    assert "noise 3 (+20 %)" in careful
    proud = told((0.9, 0.85, 0.95), nees=4.0)
    assert proud.startswith("Adopt with care.")
    assert "must not be trusted" in proud
    assert told((0.99, 0.95, 1.02)).startswith("Keep the published values.")
    assert "costs nothing: gate.threshold" in careful


def test_a_verdict_holds_every_section_and_figure(tmp_path: Path) -> None:
    report = Report(tmp_path, "Verdict")
    text = verdict(report, tuned(motion__acceleration=3.0), 6, 2)
    page = report.write().with_suffix(".html").read_text(encoding="utf-8")
    assert text.split(";")[0].replace("'", "&#x27;") in page or text.split(";")[0] in page
    for section in ("held out", "what changed", "trustworthy", "beyond what it was tuned on"):
        assert section in page
    assert page.count("<img ") == 3
    data = json.loads((tmp_path / "report.json").read_text())
    assert len(data["tables"]["gate-lockout stress"]) == sum(
        len(levels) for _, levels in CONDITIONS.values()
    )


def command(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "difffilter", "report", *words],
        capture_output=True, text=True, check=False,
    )  # fmt: skip


def test_the_command_writes_one_page_and_prints_the_advice(tmp_path: Path) -> None:
    place = tmp_path / "mine.json"
    save(tuned(motion__acceleration=3.0), place)
    done = command(str(place), "--trajectories", "4", "--out", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("gate-lockout, gated: ")
    assert (tmp_path / "out" / "report.html").is_file()
    recorded = replace(load_checkpoint("uwb-ranges"))
    save(recorded, tmp_path / "uwb.json")
    for words, message in (
        ((str(tmp_path / "uwb.json"),), "uwb-ranges: has no world, expected --log"),
        ((str(place), "--out", str(place)), "found a file, expected a folder"),
        ((str(place), str(place), "--log", "x.csv"), "expected one with recorded logs"),
    ):
        done = command(*words)
        assert done.returncode == 2
        assert message in done.stderr
        assert done.stderr.count("\n") == 1


def load_checkpoint(name: str) -> Checkpoint:
    from difffilter.checkpoint import load

    return load(Path(__file__).parent.parent / "checkpoints" / f"{name}.json")
