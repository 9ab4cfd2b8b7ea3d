"""Long logs in windows of rows, estimates as CSV and Parquet, covariances."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from cli_helpers import TINY, fails, read_columns

import difffilter
from difffilter.cli.main import main
from difffilter.logs.tables import read_table
from difffilter.running import windows
from difffilter.running.windows import run_windows
from difffilter.scenario.estimation import started
from difffilter.scenario.recorded import load_logs


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("tiny.toml").write_text(TINY)
    assert main(["simulate", "tiny.toml", "--trajectories", "1", "--out", "log.csv"]) == 0
    return tmp_path


@pytest.mark.parametrize("engine", ["torch", "fused"])
@pytest.mark.parametrize("rows", [1, 7, 20, 100])
def test_windows_together_are_one_run(place: Path, rows: int, engine: str) -> None:
    scenario = difffilter.load_scenario("tiny.toml")
    system = scenario.system("m-ekf")
    log = started(scenario, system, load_logs(scenario, ["log.csv"]))
    whole = difffilter.run(system, log, engine="torch")
    parts = list(run_windows(system, log, rows=rows, engine=engine))
    assert [p.steps for p, _ in parts] == [min(rows, 20 - k) for k in range(0, 20, rows)]
    mean = torch.cat([track.mean for _, track in parts])
    torch.testing.assert_close(mean, whole.mean, rtol=1e-9, atol=1e-9)
    nis = torch.cat([track.record.nis for _, track in parts if track.record is not None])
    assert whole.record is not None
    torch.testing.assert_close(nis, whole.record.nis, rtol=1e-7, atol=1e-9)


def test_covariances_are_written(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those of the filter's own run; and a run in small windows writes the same file."""
    arguments = ["run", "tiny.toml", "log.csv", "--covariance", "--system", "m-ekf", "--out"]
    assert main([*arguments, "out.csv"]) == 0
    found = read_columns(Path("out.csv"))
    scenario = difffilter.load_scenario("tiny.toml")
    system = scenario.system("m-ekf")
    log = started(scenario, system, load_logs(scenario, ["log.csv"]))
    covariance = difffilter.run(system, log, engine="torch").covariance[:, 0]
    assert found["cov_x_vy"] == pytest.approx(covariance[:, 0, 3].tolist(), rel=1e-8, abs=1e-9)
    assert found["y_std"] == pytest.approx(covariance[:, 1, 1].sqrt().tolist(), rel=1e-8)
    monkeypatch.setattr(windows.run_windows, "__kwdefaults__", {
        **(windows.run_windows.__kwdefaults__ or {}), "rows": 6,
    })  # fmt: skip
    assert main([*arguments, "parts.csv"]) == 0
    again = read_columns(Path("parts.csv"))
    for name, values in found.items():
        assert again[name] == pytest.approx(values, rel=1e-9, abs=1e-9)


def test_no_rows_are_no_window(place: Path) -> None:
    scenario = difffilter.load_scenario("tiny.toml")
    system = scenario.system("m-ekf")
    log = started(scenario, system, load_logs(scenario, ["log.csv"]))
    wrong = run_windows(system, log, rows=0)
    with pytest.raises(difffilter.InputError, match="rows: found 0"):
        next(wrong)


def test_parquet(place: Path, capsys: Any) -> None:
    arguments = ["run", "tiny.toml", "log.csv", "--out"]
    assert main([*arguments, "out.csv"]) == 0
    try:
        import pyarrow  # noqa: F401
    except ImportError:
        assert "pip install 'difffilter[logs]'" in fails(capsys, *arguments, "out.parquet")
        assert not Path("out.parquet").exists()
        pytest.skip("pyarrow is not installed")
    assert main([*arguments, "out.parquet"]) == 0
    table = read_table(Path("out.parquet"))
    for name, values in read_columns(Path("out.csv")).items():
        assert np.asarray(table.columns[name]).tolist() == values


def test_a_large_file_is_read_as_a_small_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By pyarrow where it is installed: the same numbers, and errors of the same line."""
    pytest.importorskip("pyarrow")
    from difffilter.logs import tables

    path = tmp_path / "a.csv"
    path.write_text("time,a,b\n0.1,1e300,\n0.2,nan,-0.0\n0.30000000000000004,5,7\n")
    small = read_table(path)
    monkeypatch.setattr(tables, "LARGE", 1)
    assert tables._large(path, ",", ".") is not None
    large = read_table(path)
    assert large.names == small.names
    assert large.lines.tolist() == small.lines.tolist()
    for name in small.names:
        np.testing.assert_array_equal(large.columns[name], small.columns[name])
    path.write_text('"time","a",b\n0.1,1,2\n')
    assert tables._large(path, ",", ".") is not None
    assert read_table(path).names == ("time", "a", "b")
    for wrong in ("0.4,inf,1", "0.4,x,1", '0.4,"1",1', "0.4,1", ""):
        path.write_text(f"time,a,b\n0.1,1,2\n{wrong}\n0.5,1,1\n")
        assert tables._large(path, ",", ".") is None


WORLD = """\
schema = 1
name = "jump"
title = "One coordinate jumps for good"
[sensors.fix]
kind = "position"
[parameters.motion.acceleration]
value = 0.1
[parameters.fix.sigma]
value = 1.0
[parameters.start.sigma]
value = [1.0, 1.0, 0.1, 0.1]
[systems.robust]
weight = "igg3"
"""


@pytest.mark.parametrize(("rows", "told"), [(29, False), (30, True), (45, True)])
def test_a_channel_rejected_for_long_is_told(
    rows: int, told: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    scenario, log = tmp_path / "jump.toml", tmp_path / "log.csv"
    scenario.write_text(WORLD)
    lines = [f"{k},{500.0 if k >= 10 else 0.1 * (k % 2)},{0.1 * (k % 3)}" for k in range(rows)]
    log.write_text("\n".join(["time,fix_1,fix_2", *lines]) + "\n")
    assert main(["run", str(scenario), str(log), "--out", str(tmp_path / "out.csv")]) == 0
    said = capsys.readouterr().err
    assert (f"fix_1 was rejected {rows - 10} times in a row" in said) is told
    assert "fix_2 was rejected" not in said
