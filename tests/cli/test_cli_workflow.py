"""Simulate, tune, compare and run as a user does: one process per command."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest
from cli_helpers import CHANNELS, STATES, TINY, process, read_columns, strict_json, succeeds

import difffilter


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the scenario, three logs and a tuned checkpoint, made by commands."""
    folder = tmp_path_factory.mktemp("cli")
    (folder / "tiny.toml").write_text(TINY)
    text = succeeds(
        "simulate", "tiny.toml", "--trajectories", 3, "--seed", 7, "--out", "logs", cwd=folder
    )
    assert "3 logs of 20 rows" in text
    text = succeeds(
        "tune", "tiny.toml", "--out", "mine.json", "--tensorboard", "board", "--seed", 3, cwd=folder
    )
    (folder / "tune.txt").write_text(text)
    return folder


def test_simulated_logs(place: Path) -> None:
    names = sorted(path.name for path in (place / "logs").iterdir())
    assert names == ["tiny-7-0000.csv", "tiny-7-0001.csv", "tiny-7-0002.csv"]
    columns = read_columns(place / "logs" / names[1])
    assert list(columns) == ["time", *CHANNELS, *(f"truth_{state}" for state in STATES)]
    log = difffilter.simulate(difffilter.load_scenario(place / "tiny.toml"), 3, 7)
    assert columns["tdoa_5"] == log.z[:, 1, 3].tolist()
    assert log.truth is not None
    assert columns["truth_vy"] == log.truth[:, 1, 3].tolist()


def test_tune_prints_values_and_held_out_result(place: Path) -> None:
    text = (place / "tune.txt").read_text()
    checkpoint = difffilter.load(place / "mine.json")
    assert checkpoint.training["seed"] == 3
    tuned = float(checkpoint.values["tdoa.sigma"]) / 0.299792458
    line = next(line for line in text.splitlines() if "tdoa.sigma" in line)
    assert line.split() == ["tdoa.sigma", "10", "->", f"{tuned:.6g}", "ns"]
    assert "| m-ekf | tuned |" in text
    assert text.rstrip().endswith("checkpoint written to mine.json")
    assert list((place / "board").rglob("events*"))
    assert not (place / "mine.state.pt").exists()


def test_compare_json(place: Path) -> None:
    options = ["--values", "published", "--values", "mine.json", "--trajectories", 4, "--json"]
    result = strict_json(succeeds("compare", "tiny.toml", *options, cwd=place))
    assert result["scenario"] == "tiny"
    assert (result["trajectories"], result["seed"]) == (4, 1)
    systems = difffilter.load_scenario("airport-mlat").systems
    found = [(row["system"], row["values"]) for row in result["rows"]]
    assert found == [*((name, "published") for name in systems), ("m-ekf", "mine.json")]
    for row in result["rows"]:
        low, high = row["ci95"]
        assert low <= row["rmse"] <= high
        assert row["nees_per_state"] > 0
        assert "per_scene" not in row


def test_run_writes_estimates(place: Path) -> None:
    """The file's own numbers give the RMSE and the shares that the JSON claims."""
    options = ["--out", "estimates.csv", "--plot", "track.png", "--json"]
    path = "logs/tiny-7-0001.csv"
    result = strict_json(succeeds("run", "mine.json", path, *options, cwd=place))
    log, got = read_columns(place / path), read_columns(place / "estimates.csv")
    weights = [f"{channel}_weight" for channel in CHANNELS]
    assert set(got) == {"time", *STATES, *(f"{s}_std" for s in STATES), *weights, "nis"}
    assert got["time"] == log["time"]
    squared = [
        (got[s][k] - log[f"truth_{s}"][k]) ** 2  # type: ignore[operator]
        for s in ("x", "y")
        for k in range(20)
    ]
    assert result["rows"] == 20
    assert result["rmse"] == pytest.approx(math.sqrt(sum(squared) / 20), rel=1e-12)
    for channel in CHANNELS:
        weight = got[f"{channel}_weight"]
        assert all(w is not None and 0 <= w <= 1 for w in weight)
        low = sum(w < 0.1 for w in weight)  # type: ignore[operator]
        assert result["rejected"][channel] == pytest.approx(low / 20, abs=1e-6)
    assert all(value is not None and value > 0 for value in got["x_std"] + got["nis"])
    for name in ("track.png", "track.svg"):
        assert (place / name).stat().st_size > 10_000


def test_round_trip_agrees_with_compare(place: Path) -> None:
    """A log run alone has the RMSE that compare gives it."""
    path = "logs/tiny-7-0002.csv"
    arguments = ["run", "tiny.toml", path, "--system", "ekf", "--out", "ekf.csv", "--json"]
    alone = strict_json(succeeds(*arguments, cwd=place))
    arguments = ["compare", "tiny.toml", "--system", "ekf", "--log", path, "--out", "ekf.json"]
    text = succeeds(*arguments, cwd=place)
    written = strict_json((place / "ekf.json").read_text())
    assert written["seed"] is None
    assert written["rows"][0]["rmse"] == pytest.approx(alone["rmse"], rel=1e-9)
    assert f"| ekf | published | {alone['rmse']:.3f} |" in text


def test_tune_on_recorded_logs(place: Path) -> None:
    logs = [f"logs/tiny-7-000{i}.csv" for i in range(2)]
    options = ["--loss", "likelihood=1", "--steps", 1, "--set", "tuning.window=10", "--json"]
    arguments = ["tune", "tiny.toml", "--system", "ekf", "--log", *logs, *options]
    result = strict_json(succeeds(*arguments, cwd=place))
    assert (result["system"], result["checkpoint"]) == ("ekf", "runs/tiny.json")
    assert result["training"]["loss"] == {"likelihood": 1.0}
    assert result["training"]["data"] == ["tiny-7-0000", "tiny-7-0001"]
    assert set(result["values"]["tdoa.sigma"]) == {"published", "tuned", "unit", "standard_error"}
    stored = json.loads((place / "runs/tiny.json").read_text())
    assert stored["document"]["tuning"]["window"] == 10


def test_wrong_input_in_a_process(place: Path) -> None:
    done = process("run", "mine.json", "nothing.csv", "--out", "never.csv", cwd=place)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr.startswith("difffilter: error: nothing.csv: cannot be read")
    assert done.stderr.count("\n") == 1
    assert not (place / "never.csv").exists()
