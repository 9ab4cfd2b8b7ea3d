"""Direction-finding logs through the command line: a platform's columns, gaps, wild bearings."""

from __future__ import annotations

import math
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch
from cli_helpers import check_failure, fails, process, read_columns, strict_json, succeeds

import difffilter as df
from difffilter.cli.main import main

NAME = "airborne-bearing-absolute"
STATES = ("x", "y", "vx", "vy")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of the absolute form, simulated by a process of its own."""
    path = tmp_path_factory.mktemp("logs") / "log.csv"
    succeeds("simulate", NAME, "--trajectories", 1, "--seed", 5, "--out", path)
    return path


@pytest.fixture
def place(simulated: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a copy of the log to spoil."""
    monkeypatch.chdir(tmp_path)
    shutil.copy(simulated, "log.csv")
    return tmp_path


def edit(changes: dict[tuple[str, int], str], drop: tuple[str, ...] = ()) -> None:
    """Change fields of log.csv by column and row (from 1), leave columns out."""
    lines = [line.split(",") for line in Path("log.csv").read_text().splitlines()]
    header = list(lines[0])
    for (column, row), text in changes.items():
        lines[row][header.index(column)] = text
    kept = [i for i, name in enumerate(header) if name not in drop]
    Path("log.csv").write_text("\n".join(",".join(line[i] for i in kept) for line in lines) + "\n")


def remove(first: int, last: int) -> None:
    """Leave rows out."""
    lines = Path("log.csv").read_text().splitlines()
    Path("log.csv").write_text("\n".join(lines[:first] + lines[last + 1 :]) + "\n")


def in_library(system: str) -> tuple[df.Log, df.Track]:
    """What the library makes of log.csv."""
    scenario = df.load_scenario(NAME)
    log = df.load_logs(scenario, ["log.csv"])
    chosen = scenario.system(system)
    return log, df.estimate(chosen, df.started(scenario, chosen, log))


def check_estimates(path: Path, track: df.Track) -> None:
    """The file holds the track's numbers."""
    got = read_columns(path)
    for i, name in enumerate(track.states):
        for column, value in ((name, track.mean), (f"{name}_std", track.std)):
            expected = value[..., i].reshape(-1).tolist()
            for found, number in zip(got[column], expected, strict=True):
                assert (found is None and math.isnan(number)) or found == pytest.approx(
                    number, rel=1e-12, abs=1e-12
                )


def run(capsys: Any, *options: str) -> dict[str, Any]:
    """The JSON of a run that writes out.csv."""
    capsys.readouterr()
    assert main(["run", NAME, "log.csv", "--out", "out.csv", "--json", *options]) == 0
    result: dict[str, Any] = strict_json(capsys.readouterr().out)
    return result


def test_a_simulated_log_has_the_platform_beside_the_bearing(place: Path) -> None:
    got = read_columns(Path("log.csv"))
    assert list(got) == [
        "time", "bearing", "platform_x", "platform_y", *(f"truth_{name}" for name in STATES),
    ]  # fmt: skip
    assert got["platform_x"] == [600.0 * k for k in range(1, 201)]
    assert set(got["platform_y"]) == {0.0}
    log = df.simulate(df.load_scenario(NAME), 1, seed=5)
    assert got["bearing"] == log.z.reshape(-1).tolist()


def test_a_run_in_a_process_is_the_librarys(place: Path) -> None:
    text = succeeds("run", NAME, "log.csv", "--out", "out.csv", "--json", cwd=place)
    result = strict_json(text)
    log, track = in_library("gated")
    check_estimates(Path("out.csv"), track)
    scenario = df.load_scenario(NAME)
    assert result["rmse"] == pytest.approx(float(df.rmse(log, track, scenario.score)), rel=1e-9)
    assert (result["rows"], result["system"], result["scenario"]) == (200, "gated", NAME)
    assert result["rmse"] < 100.0


@pytest.mark.parametrize("system", ["ekf", "robust", "ls", "weighted-ls"])
def test_every_system_runs_over_a_log(place: Path, capsys: Any, system: str) -> None:
    assert run(capsys, "--system", system)["rmse"] > 0
    check_estimates(Path("out.csv"), in_library(system)[1])


def test_a_log_without_the_platform_is_one_clear_line(place: Path, capsys: Any) -> None:
    edit({}, drop=("platform_y",))
    line = fails(capsys, "run", NAME, "log.csv", "--out", "out.csv")
    assert "log.csv, line 1" in line
    assert "expected 'platform_y' among them" in line
    edit({}, drop=("platform_x",))
    done = process("run", NAME, "log.csv", "--out", "out.csv", cwd=place)
    check_failure(done.returncode, done.stdout, done.stderr)
    assert "expected 'platform_x' among them" in done.stderr
    assert not Path("out.csv").exists()


def test_a_gap_in_the_platforms_path_is_named_by_line(place: Path, capsys: Any) -> None:
    edit({("platform_y", 7): ""})
    line = fails(capsys, "run", NAME, "log.csv", "--out", "out.csv")
    assert "log.csv, line 8, column platform_y: found nothing, expected a number" in line


def test_rows_without_a_bearing_are_predicted(place: Path, capsys: Any) -> None:
    edit({("bearing", row): "" for row in (1, 4, *range(60, 90))})
    result = run(capsys)
    got = read_columns(Path("out.csv"))
    assert got["bearing_weight"][59:89] == [0.0] * 30
    assert [got["bearing_weight"][row - 1] for row in (1, 4)] == [0.0, 0.0]
    assert got["bearing_weight"][1] == 1.0
    x_std = [value for value in got["x_std"] if value is not None]
    assert len(x_std) == 200
    assert x_std[88] > x_std[58]
    assert result["rmse"] < 150.0
    check_estimates(Path("out.csv"), in_library("gated")[1])


def test_rows_that_are_not_there_are_predicted_over(place: Path, capsys: Any) -> None:
    edit({("bearing", row): "" for row in range(60, 90)})
    run(capsys)
    empty = read_columns(Path("out.csv"))
    remove(60, 89)
    assert run(capsys)["rows"] == 170
    gone = read_columns(Path("out.csv"))
    assert gone["time"][58:60] == [59.0, 90.0]
    for name in STATES[:2]:  # process noise of one long step is not that of thirty short ones
        there, here = empty[name][89], gone[name][59]
        assert there is not None
        assert here == pytest.approx(there, rel=5e-3)
    check_estimates(Path("out.csv"), in_library("gated")[1])


def test_wild_bearings_hardly_move_the_robust_filter(place: Path, capsys: Any) -> None:
    before = {name: run(capsys, "--system", name)["rmse"] for name in ("gated", "ekf")}
    wild = {("bearing", row): str(-3.0 + 0.05 * row) for row in (55, 70, 71, 95)}
    edit(wild)
    after = {name: run(capsys, "--system", name)["rmse"] for name in ("gated", "ekf")}
    assert after["gated"] < before["gated"] + 10.0
    assert after["ekf"] > 10.0 * before["ekf"]
    run(capsys)
    weights = read_columns(Path("out.csv"))["bearing_weight"]
    assert [weights[row - 1] for row in (55, 70, 71, 95)] == [0.0] * 4


def _turned(bearing: float | None) -> float:
    """A whole turn further, and still within a turn."""
    assert bearing is not None
    return bearing - math.copysign(2 * math.pi, bearing)


def test_whole_turns_in_the_log_change_nothing(place: Path, capsys: Any) -> None:
    run(capsys)
    before = read_columns(Path("out.csv"))
    bearings = read_columns(Path("log.csv"))["bearing"]
    edit({
        ("bearing", row): repr(_turned(bearings[row - 1]) if row % 2 else bearings[row - 1])
        for row in range(1, 201)
    })  # fmt: skip
    run(capsys)
    after = read_columns(Path("out.csv"))
    for name in STATES:
        for found, expected in zip(after[name], before[name], strict=True):
            assert found == pytest.approx(expected, rel=1e-6, abs=1e-3)


def test_first_bearings_that_do_not_cross_are_one_clear_line(place: Path, capsys: Any) -> None:
    edit({("bearing", row): "" for row in range(2, 201)})
    line = fails(capsys, "run", NAME, "log.csv", "--out", "out.csv")
    assert "start: trajectory log: its first 6 bearings do not cross" in line
    assert not Path("out.csv").exists()


def test_first_bearings_from_behind_are_one_clear_line(place: Path, capsys: Any) -> None:
    bearings = read_columns(Path("log.csv"))["bearing"]
    edit({("bearing", row): repr(bearings[row - 1] - math.pi) for row in range(1, 7)})  # type: ignore[operator]
    line = fails(capsys, "run", NAME, "log.csv", "--out", "out.csv")
    assert "start: trajectory log: its first 6 bearings cross behind the observer" in line


def test_a_log_of_the_relative_form_needs_no_platform(place: Path, capsys: Any) -> None:
    edit({}, drop=("platform_x", "platform_y", *(f"truth_{name}" for name in STATES)))
    capsys.readouterr()
    assert main(["run", "airborne-bearing", "log.csv", "--out", "out.csv", "--json"]) == 0
    assert strict_json(capsys.readouterr().out)["rmse"] is None
    relative = read_columns(Path("out.csv"))
    log = df.simulate(df.load_scenario(NAME), 1, seed=5)
    scenario = df.load_scenario(NAME)
    system = scenario.system()
    track = df.estimate(system, df.started(scenario, system, log))
    path = torch.stack([log.inputs["platform_x"], log.inputs["platform_y"]], dim=-1)
    expected = (track.mean[..., :2] - path).reshape(200, 2)
    for i, name in enumerate(("x", "y")):
        for found, number in zip(relative[name], expected[:, i].tolist(), strict=True):
            assert found == pytest.approx(number, rel=1e-7, abs=1e-3)
