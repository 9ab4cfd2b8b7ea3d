"""``difffilter import`` and foreign logs on the command line."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from cli_helpers import fails, read_columns, strict_json

from difffilter.cli.main import main

RANGES = """\
schema = 1
name = "ranges"
title = "Ranges in feet, one anchor at a time; the truth in a file of its own"
[log]
format = "unix-ms"
gap = 2.0
[log.files.ranges]
file = "{run}/ranges.csv"
by = "anchor"
value = "feet"
columns = { a = "r_1", b = "r_2", c = "r_3" }
units = { r_1 = "ft", r_2 = "ft", r_3 = "ft" }
[log.files.truth]
file = "{run}/truth.csv"
columns = { east = "truth_x", north = "truth_y" }
[sensors]
r = { kind = "range", stations = [[0.0, 0.0], [100.0, 0.0], [0.0, 100.0]] }
[start]
rows = 9
[parameters]
motion.acceleration = { value = 0.1, tuned = true }
r.sigma = { value = 0.1 }
start.sigma = { value = [1.0, 1.0, 1.0, 1.0] }
[systems.ekf]
"""


def raw(folder: Path) -> None:
    """Somebody walks from (30, 40) at (1, -0.5) m/s; one row is late, one comes twice."""
    folder.mkdir()
    anchors = {"a": (0.0, 0.0), "b": (100.0, 0.0), "c": (0.0, 100.0)}
    rows = []
    for k in range(60):
        t, (name, at) = 0.5 * k, list(anchors.items())[k % 3]
        feet = math.hypot(30 + t - at[0], 40 - t / 2 - at[1]) / 0.3048
        rows.append(f"{1_600_000_000_250 + 500 * k},{name},{feet!r}")
    rows[10], rows[11] = rows[11], rows[10]
    rows.append(rows[-1])
    (folder / "ranges.csv").write_text("time,anchor,feet\n" + "\n".join(rows) + "\n")
    truth = [f"{1_600_000_000_250 + 1000 * k},{30 + k},{40 - k / 2}" for k in range(-3, 25)]
    (folder / "truth.csv").write_text("time,east,north\n" + "\n".join(truth) + "\n")


def test_raw_files_and_the_imported_log_give_the_same(
    tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("ranges.toml").write_text(RANGES)
    raw(Path("walk"))
    assert main(["import", "ranges.toml", "walk", "--out", "one.csv", "--json"]) == 0
    report = strict_json(capsys.readouterr().out)
    assert report["rows"] == 60
    assert report["seconds"] == 29.5
    assert report["first"] == "1600000000250"
    assert report["measurements"] == {"r_1": 20, "r_2": 20, "r_3": 20}
    assert report["truth"] == {"x": 49, "y": 49}  # to the last sample, never beyond
    assert len(report["told"]) == 2
    assert "time ran back in 1 rows, by 0.5 s at most" in report["told"][0]
    assert "1 rows joined to one of the same time" in report["told"][1]
    text = Path("one.csv").read_text()
    assert text.startswith("# difffilter log 1, ranges, SI units, seconds from 2020-09-13T12:26:40")
    for source, out in (("walk", "raw.csv"), ("one.csv", "again.csv")):
        assert main(["run", "ranges.toml", source, "--out", out, "--engine", "torch"]) == 0
    assert "rows joined" in capsys.readouterr().err
    first, again = read_columns(Path("raw.csv")), read_columns(Path("again.csv"))
    assert first["time"][:2] == [1600000000250.0, 1600000000750.0]
    assert again["time"][:2] == [0.25, 0.75]
    for name in set(first) - {"time"}:
        assert first[name] == again[name]
    np.testing.assert_allclose(first["x"][-1], 30 + 29.5, atol=0.05)
    np.testing.assert_allclose(first["y"][-1], 40 - 29.5 / 2, atol=0.05)


def test_what_is_wrong_with_the_files_is_one_line(
    tmp_path: Path, monkeypatch: Any, capsys: Any
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("ranges.toml").write_text(RANGES)
    raw(Path("walk"))
    run = ("import", "ranges.toml", "walk", "--out", "one.csv")
    assert "gap" in fails(capsys, *run, "--set", "log.gap=-1")
    assert "'fathom', expected one of m, km" in fails(
        capsys, *run, "--set", 'log.files.ranges.units={r_1="fathom"}'
    )
    Path("ranges.toml").write_text(RANGES.replace("gap = 2.0\n", ""))
    assert "[log] gap" in fails(capsys, *run)
    Path("walk/truth.csv").unlink()
    assert "walk/truth.csv: cannot be read" in fails(capsys, *run)
    assert not Path("one.csv").exists()
    assert "expected a name beside the log" in fails(
        capsys, *run, "--set", "log.files.truth.file=../truth.csv"
    )
