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

from difffilter import load_scenario, run, simulate, started
from difffilter.comparison.table import Row
from difffilter.filters.recipe import Recipe
from difffilter.reports.report import Report
from difffilter.scenario.checkpoint import Checkpoint, save
from difffilter.scoring.metrics import position_error, scored_rows
from difffilter.verdict.flags import Flag
from difffilter.verdict.grade import GRADES, Grade, grade
from difffilter.verdict.judge import verdict
from difffilter.verdict.stresses import Stressed
from difffilter.verdict.what_changed import changes

SCENARIO = load_scenario("gate-lockout", {"world.steps": 40})
CLEAN = SCENARIO.with_overrides({"tuning.system": "gated"})


def tuned(**values: float) -> Checkpoint:
    """A checkpoint of ``gated`` with some values changed."""
    filter = CLEAN.system("gated")
    assert isinstance(filter, Recipe)
    changed = {name.replace("__", "."): tensor(value) for name, value in values.items()}
    training = {"standard_errors": {"position.sigma": 0.5}}
    return Checkpoint(CLEAN, "gated", filter.published() | changed, None, training)


LOG = simulate(CLEAN, 12, 4, "test")


def rmse_of(values: dict[str, torch.Tensor]) -> float:
    filter = CLEAN.system("gated")
    assert isinstance(filter, Recipe)
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


def row(values: str, ratio: tuple[float, float, float], nees: float = 1.1) -> Row:
    return Row("gated", values, 2.0, (1.9, 2.1), 2.0, ratio[0], ratio[1:], nees, 1.0, 1.0, {}, {})


def told(
    ratio: tuple[float, float, float],
    worse: float = 1.0,
    nees: float = 1.1,
    before: float = 1.1,
    plausible: str = "not stated",
    flags: tuple[Flag, ...] = (),
) -> Grade:
    under = Stressed(
        "noise", "twice the noise", "the spread", plausible, True, 1.0, worse, (1.0, 1.0),
        (worse, worse - 0.01, worse + 0.01), {"position": (1.0, 1.0)},
    )  # fmt: skip
    published = row("published", (1.0, 1.0, 1.0), before)
    return grade(published, row("tuned", ratio, nees), flags, [under], {"noise": ("a.sigma",)})


def test_the_grade_follows_from_the_numbers() -> None:
    assert told((0.9, 0.85, 0.95)).word == "adopt"
    assert told((0.9, 0.85, 0.95), worse=1.1).word == "adopt"  # not surely above 10 %
    careful = told((0.9, 0.85, 0.95), worse=1.2)
    assert careful.word == "adopt if"
    assert "twice the noise" in careful.text
    assert "keep a.sigma as published" in careful.text
    flag = Flag("capped", "tuning", "ended at its cap", "on the way", "nothing")
    assert told((0.9, 0.85, 0.95), flags=(flag,)).word == "adopt if"
    assert told((0.99, 0.95, 1.02)).word == "keep"
    assert "lose" in told((1.2, 1.1, 1.3)).why
    assert told((0.9, 0.85, 0.95), worse=2.5).word == "adopt if"
    assert told((0.9, 0.85, 0.95), worse=2.5, plausible="every winter").word == "keep"


def test_an_honest_covariance_is_a_reason_to_adopt_where_the_error_stays() -> None:
    assert told((0.99, 0.95, 1.02), before=17.6).text.startswith("Adopt: for their covariance")
    assert told((0.99, 0.95, 1.02), worse=1.2, before=17.6).word == "adopt if"
    for ratio, nees, before in (
        ((1.1, 0.95, 1.2), 1.1, 17.6),  # not at the price of the error
        ((0.99, 0.95, 1.02), 5.0, 17.6),  # not where it stays dishonest
    ):
        assert told(ratio, nees=nees, before=before).word == "keep"


def test_a_condition_that_misleads_forbids_a_plain_adopt() -> None:
    one = Stressed(
        "turn", "a turn", "innovations", "not stated", True, 1.0, 1.0, (1.0, 4.0),
        (1.0, 0.99, 1.01), {"velocity along the short axis": (1.2, 40.0)},
    )  # fmt: skip
    published, tuned = row("published", (1.0, 1.0, 1.0)), row("tuned", (0.9, 0.85, 0.95))
    assert grade(published, tuned, (), [one]).word == "adopt if"
    shown = replace(one, decisive=False)
    assert grade(published, tuned, (), [shown]).word == "adopt"


def test_a_verdict_holds_every_section_and_figure(tmp_path: Path) -> None:
    report = Report(tmp_path, "Verdict")
    text = verdict(report, tuned(motion__acceleration=3.0), 6, 2)
    page = report.write().with_suffix(".html").read_text(encoding="utf-8")
    assert text.partition(";")[0].partition(": ")[2] in page
    for section in (
        "Held out", "What changed", "trustworthy", "that nobody tuned on", "NEES by direction",
        "Is the gradient worth it?", "the contest of tuners was not asked for",
    ):  # fmt: skip
        assert section in page
    assert page.count("<img ") == 2
    assert page.index("What to do") < page.index("<details>")
    data = json.loads((tmp_path / "report.json").read_text())
    assert data["verdicts"] == {"gate-lockout, gated": text}
    judged = data["judged"]["gate-lockout, gated"]
    assert judged["grade"] in GRADES
    assert len(judged["conditions"]) == len(data["tables"]["gate-lockout conditions"]) > 10


def test_checkpoints_of_one_scenario_have_names_of_their_own(tmp_path: Path) -> None:
    places = [tmp_path / "first.json", tmp_path / "second.json"]
    save(tuned(motion__acceleration=3.0), places[0])
    save(tuned(motion__acceleration=2.0), places[1])
    done = command(*map(str, places), "--trajectories", "4", "--out", str(tmp_path / "out"))
    assert done.returncode == 0, done.stderr
    data = json.loads((tmp_path / "out" / "report.json").read_text())
    assert set(data["verdicts"]) == {"first, gated", "second, gated"}
    for stem in ("first", "second"):
        assert (tmp_path / "out" / stem / "report.html").is_file()
        assert f'href="{stem}/report.html"' in (tmp_path / "out" / "report.html").read_text()


def test_a_verdict_compares_the_gradient_with_searches_and_noise_estimates(
    tmp_path: Path,
) -> None:
    small = SCENARIO.with_overrides(
        {"tuning.system": "gated", "tuning.steps": 2, "tuning.trajectories": 4,
         "tuning.validation": 4, "tuning.evaluate_every": 1,
         "parameters.motion.acceleration.tuned": True}
    )  # fmt: skip
    checkpoint = replace(tuned(motion__acceleration=3.0), scenario=small)
    report = Report(tmp_path, "Verdict")
    verdict(report, checkpoint, 4, 2, seeds=(0,))
    data = json.loads(report.write().with_suffix(".json").read_text())
    methods = [row["method"] for row in data["tables"]["gate-lockout contest"]]
    assert methods[1:] == ["random", "nelder-mead", "cma-es"]
    first, *_, last = data["tables"]["gate-lockout gain"]
    assert (first["ratio to published"], first["95 % interval"]) == (1.0, [1.0, 1.0])
    assert first["what is estimated, and how"] == "published"
    assert last["what is estimated, and how"] == "all: gradient"


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
    assert done.stdout.startswith("mine, gated: ")
    assert (tmp_path / "out" / "report.html").is_file()
    recorded = replace(load_checkpoint("uwb-ranges"))
    save(recorded, tmp_path / "uwb.json")
    for words, message in (
        ((str(tmp_path / "uwb.json"),), "uwb-ranges: has no world, expected --log"),
        ((str(place), "--out", str(place)), "found a file, expected a folder"),
        ((str(place), str(place), "--log", "x.csv"), "x.csv: cannot be read"),
        ((str(place), "--train", "x.csv"), "found no --log beside it"),
    ):
        done = command(*words)
        assert done.returncode == 2
        assert message in done.stderr
        assert done.stderr.count("\n") == 1


def load_checkpoint(name: str) -> Checkpoint:
    from difffilter.scenario.checkpoint import load

    return load(Path(__file__).parents[2] / "checkpoints" / f"{name}.json")
