"""``difffilter run``: gaps, logs without truth, baselines, overrides, recorded runs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_helpers import CHANNELS, TINY, fails, read_columns, strict_json

import difffilter
from difffilter.cli.main import main


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with a scenario, a log and a checkpoint of the published values."""
    monkeypatch.chdir(tmp_path)
    Path("tiny.toml").write_text(TINY)
    assert main(["simulate", "tiny.toml", "--trajectories", "1", "--out", "log.csv"]) == 0
    scenario = difffilter.load_scenario("tiny.toml")
    system = scenario.system("m-ekf")
    difffilter.save(difffilter.Checkpoint(scenario, "m-ekf", system.published()), "frozen.json")
    return tmp_path


def run(capsys: Any, *arguments: str) -> dict[str, Any]:
    """The JSON of a run that writes out.csv."""
    capsys.readouterr()
    assert main(["run", *arguments, "--out", "out.csv", "--json"]) == 0
    result: dict[str, Any] = strict_json(capsys.readouterr().out)
    return result


def edit(column: str, row: int | None, text: str) -> None:
    """Change a field of log.csv, or with ``row`` None leave the column out."""
    lines = [line.split(",") for line in Path("log.csv").read_text().splitlines()]
    at = lines[0].index(column)
    for i, line in enumerate(lines):
        if row is None:
            del line[at]
        elif i == row:
            line[at] = text
    Path("log.csv").write_text("\n".join(",".join(line) for line in lines) + "\n")


def test_frozen_values_are_the_published_ones_where_frozen_so(place: Path, capsys: Any) -> None:
    frozen = run(capsys, "frozen.json", "log.csv")
    kept = Path("out.csv").read_text()
    assert run(capsys, "frozen.json", "log.csv", "--values", "published")["rmse"] == frozen["rmse"]
    assert Path("out.csv").read_text() == kept
    assert run(capsys, "tiny.toml", "log.csv", "--values", "frozen.json")["rmse"] == frozen["rmse"]
    assert Path("out.csv").read_text() == kept


def test_log_without_truth(place: Path, capsys: Any) -> None:
    for state in ("x", "y", "vx", "vy"):
        edit(f"truth_{state}", None, "")
    assert run(capsys, "frozen.json", "log.csv")["rmse"] is None
    assert main(["run", "frozen.json", "log.csv", "--out", "out.csv"]) == 0
    assert "no truth, so no RMSE" in capsys.readouterr().out


@pytest.mark.parametrize("system", ["m-ekf", "taylor-ls"])
def test_missing_channel_has_weight_zero(place: Path, capsys: Any, system: str) -> None:
    edit("tdoa_4", 3, "")
    result = run(capsys, "tiny.toml", "log.csv", "--system", system)
    got = read_columns(Path("out.csv"))
    assert got["tdoa_4_weight"][2] == 0.0
    assert got["tdoa_4_weight"][3] != 0.0
    assert set(result["rejected"]) == set(CHANNELS)
    assert result["rejected"]["tdoa_4"] == 0.0
    if system == "taylor-ls":
        assert set(got["nis"]) == {None}
        assert "vx" not in got


def test_row_without_estimate_is_empty(place: Path, capsys: Any) -> None:
    """Least squares has no answer for a row with one range difference."""
    for channel in CHANNELS[1:]:
        edit(channel, 5, "")
    result = run(capsys, "tiny.toml", "log.csv", "--system", "taylor-ls")
    got = read_columns(Path("out.csv"))
    assert [got[name][4] for name in ("x", "x_std", "y")] == [None, None, None]
    assert got["tdoa_2_weight"][4] == 1.0
    assert result["rows"] == 20
    assert result["rmse"] > 0


def test_wild_value_is_rejected(place: Path, capsys: Any) -> None:
    edit("tdoa_6", 12, "9000.0")
    result = run(capsys, "frozen.json", "log.csv")
    assert read_columns(Path("out.csv"))["tdoa_6_weight"][11] == 0.0
    assert result["rejected"]["tdoa_6"] >= 0.05 - 1e-6


def test_a_jump_of_ages_in_time_is_borne(place: Path, capsys: Any) -> None:
    """No covariance is factored on the way: the estimates follow what is measured."""
    for row in range(10, 21):
        edit("time", row, str(1e7 + row))
    run(capsys, "frozen.json", "log.csv")
    found = read_columns(Path("out.csv"))
    assert all(value is not None for name in ("x", "y", "x_std") for value in found[name])


def test_overrides_of_a_checkpoint(place: Path, capsys: Any) -> None:
    """Its stored document can be overridden; its frozen values cannot."""
    plain = run(capsys, "frozen.json", "log.csv")
    more = run(capsys, "frozen.json", "log.csv", "--set", "systems.m-ekf.iterations=1")
    assert more["rmse"] != plain["rmse"]
    change = "parameters.tdoa.sigma.value=30"
    other = run(capsys, "frozen.json", "log.csv", "--set", change, "--values", "published")
    assert other["rmse"] != plain["rmse"]
    line = fails(capsys, "run", "frozen.json", "log.csv", "--set", change, "--out", "never.csv")
    assert "frozen" in line
    assert not Path("never.csv").exists()


def test_recorded_runs_bring_their_positions(tmp_path: Path, capsys: Any) -> None:
    """The log's name, --run and --set choose the stations; a log of no run gets a note."""
    truth = [(0.1 * k, -3.0 - 0.05 * k, -4.0 + 0.05 * k) for k in range(40)]
    runs = difffilter.load_scenario("uwb-ranges").runs
    stations = runs["los_A2"]["sensors.range.stations"]
    lines = ["time,range_a3,range_a5,range_a9,range_a12,truth_x,truth_y"]
    for t, x, y in truth:
        ranges = [((x - a) ** 2 + (y - b) ** 2 + (1.0 - c) ** 2) ** 0.5 for a, b, c in stations]
        lines.append(",".join(map(repr, [t, *ranges, x, y])))
    for name in ("los_A2.csv", "mine.csv"):
        (tmp_path / name).write_text("\n".join(lines) + "\n")

    def error(name: str, *options: str) -> tuple[float, str]:
        arguments = ["run", "uwb-ranges", str(tmp_path / name), "--json", *options]
        assert main([*arguments, "--out", str(tmp_path / "out.csv")]) == 0
        printed = capsys.readouterr()
        return strict_json(printed.out)["rmse"], printed.err

    assert error("los_A2.csv")[0] < 0.1
    assert error("los_A2.csv")[1] == ""
    wrong, noted = error("mine.csv")
    assert wrong > 0.2
    assert noted.startswith("difffilter: note: uwb-ranges: log 'mine' is none of the runs los_A1")
    assert noted.count("is none of the runs") == 1
    assert "range_a5 was rejected 39 times in a row" in noted  # of positions that are not its own
    assert error("mine.csv", "--run", "los_A2") == error("los_A2.csv")
    assert error("los_A2.csv", "--run", "los_A1")[0] == wrong
    assert error("mine.csv", "--set", f"sensors.range.stations={stations}")[0] < 0.1
    base = difffilter.load_scenario("uwb-ranges").sensors["range"].model
    given = [list(station) for station in base.stations]  # type: ignore[attr-defined]
    assert error("los_A2.csv", "--set", f"sensors.range.stations={given}")[0] == wrong


def test_smoothed_beside_filtered(place: Path, capsys: Any) -> None:
    """Columns, RMSE and figure beside the filter's, which stay; a lag of 0 changes nothing."""
    system = ("tiny.toml", "log.csv", "--system", "ekf")
    plain = run(capsys, *system, "--covariance")
    kept = read_columns(Path("out.csv"))
    both = run(capsys, *system, "--covariance", "--smooth", "--plot", "both.png")
    table = read_columns(Path("out.csv"))
    assert both["rmse"] == plain["rmse"]
    assert both["smoothed_rmse"] < both["rmse"]
    assert {name: table[name] for name in kept} == kept
    assert table["x_smoothed"][-1] == table["x"][-1]
    assert table["cov_x_y_smoothed"][-1] == table["cov_x_y"][-1]
    later, first = table["x_smoothed_std"][0], table["x_std"][0]
    assert later is not None
    assert first is not None
    assert later < first
    assert Path("both.svg").is_file()
    none = run(capsys, *system, "--smooth", "--lag", "0")
    assert none["smoothed_rmse"] == pytest.approx(none["rmse"], rel=1e-12)
    assert main(["run", *system, "--smooth", "--out", "out.csv"]) == 0
    assert "m, smoothed " in capsys.readouterr().out
    alone = fails(capsys, "run", *system, "--lag", "1", "--out", "o.csv")
    assert "--lag: found without --smooth" in alone
    below = fails(capsys, "run", *system, "--smooth", "--lag=-1", "--out", "o.csv")
    assert "lag: found -1" in below
    alone = fails(capsys, "run", *system, "--passes", "1", "--out", "o.csv")
    assert "--passes: found without --smooth" in alone
    plain_weight = fails(capsys, "run", *system, "--smooth", "--passes", "1", "--out", "o.csv")
    assert "passes: found a filter whose weight is plain" in plain_weight
    assert not Path("o.csv").exists()


def test_compare_with_smoothed_rows(place: Path, capsys: Any) -> None:
    capsys.readouterr()
    command = ("compare", "tiny.toml", "--values", "published", "--trajectories", "3", "--smooth")
    assert main([*command, "--json"]) == 0
    told = capsys.readouterr()
    rows = {row["system"]: row["rmse"] for row in strict_json(told.out)["rows"]}
    assert rows["ekf smoothed"] < rows["ekf"]
    assert {"ekf", "ekf smoothed"} <= set(rows)
    for name in set(rows) - {n.removesuffix(" smoothed") for n in rows if " smoothed" in n}:
        assert name.endswith(" smoothed") or f"{name}: no smoothed row" in told.err


def test_a_mixtures_probabilities_are_columns(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    scene = "manoeuvre-fusion-1"
    small = ["--set", "world.steps=12"]
    made = ["simulate", scene, *small, "--trajectories", "1", "--out", "log.csv"]
    assert main(made) == 0
    run(capsys, scene, "log.csv", "--system", "imm-turns", "--plot", "track.png", *small)
    got = read_columns(Path("out.csv"))
    shares = [got[f"{mode}_probability"] for mode in ("calm", "left", "right", "wide")]
    assert all(0.0 <= p <= 1.0 for share in shares for p in share)
    assert [sum(row) for row in zip(*shares, strict=True)] == pytest.approx([1.0] * 12)
    assert Path("track.svg").is_file()


def test_scored_by_the_states_that_the_scenario_names(place: Path, capsys: Any) -> None:
    Path("speed.toml").write_text(TINY.replace("schema = 1", 'schema = 1\nscore_states = ["vx"]'))
    told = run(capsys, "speed.toml", "log.csv", "--system", "m-ekf")
    estimates, log = read_columns(Path("out.csv")), read_columns(Path("log.csv"))
    errors = {
        state: np.array(estimates[state]) - np.array(log[f"truth_{state}"])
        for state in ("x", "y", "vx", "vy")
    }
    assert told["rmse"] == pytest.approx(np.sqrt(np.mean(errors["vx"] ** 2)), rel=1e-9)
    assert main(["run", "speed.toml", "log.csv", "--system", "m-ekf", "--out", "out.csv"]) == 0
    assert f"RMSE {told['rmse']:.4g} m/s" in capsys.readouterr().out


def test_compare_tells_the_error_of_each_state(place: Path, capsys: Any) -> None:
    capsys.readouterr()
    assert main(["compare", "tiny.toml", "--system", "ekf", "--trajectories", "4", "--states"]) == 0
    table = capsys.readouterr().out.partition("RMSE of each state")[2].splitlines()
    head, told = (
        [cell.strip() for cell in next(x for x in table if x.startswith(f"| {word} |")).split("|")]
        for word in ("system", "ekf")
    )
    scenario = difffilter.load_scenario("tiny.toml")
    row = difffilter.compare(scenario, trajectories=4, systems=("ekf",)).rows[0]
    for name, error in row.per_state.items():
        assert float(told[head.index(name)]) == pytest.approx(error, rel=1e-3)
    assert set(row.per_state) == {"x", "y", "vx", "vy"}
    assert row.rmse**2 == pytest.approx(row.per_state["x"] ** 2 + row.per_state["y"] ** 2)
