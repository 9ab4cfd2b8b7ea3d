"""Parts of one recording, and a recording in long form with inputs, from its raw files."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from difffilter import LogError, load_logs, load_scenario
from difffilter.errors import InputError

DOCS = Path(__file__).parents[2] / "docs"
LABYRINTH = Path(__file__).parents[4] / "shared" / "data" / "labyrinth"
if not LABYRINTH.is_dir():
    LABYRINTH = Path("/work/shared/data/labyrinth")
PARTS = """\
schema = 1
name = "parts"
title = "Parts of one recording"
axes = 1
[sensors]
p = { kind = "position" }
[parameters]
motion.acceleration = { value = 1.0 }
[systems.ekf]
[log.files.p]
file = "p.csv"
[runs]
early = { "log.until" = 2.0 }
late = { "log.from" = 2.0 }
nothing = { "log.from" = 90.0 }
"""


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    (tmp_path / "parts.toml").write_text(PARTS)
    rows = "".join(f"{5.0 + k},{k}\n" for k in range(5))
    (tmp_path / "p.csv").write_text("time,p_1\n" + rows)
    return tmp_path


def test_parts_share_no_row_and_lose_none(recording: Path) -> None:
    scenario = load_scenario(recording / "parts.toml")
    early, late, whole = (
        load_logs(scenario, [recording / run]).z[:, 0, 0].tolist()
        for run in ("early", "late", "all")
    )
    assert early == [0.0, 1.0]
    assert late == [2.0, 3.0, 4.0]
    assert early + late == whole


def test_a_part_without_rows_is_an_error(recording: Path) -> None:
    scenario = load_scenario(recording / "parts.toml")
    with pytest.raises(LogError, match=r"found no row from 90 to inf s after the first.* its 4 s"):
        load_logs(scenario, [recording / "nothing"])
    with pytest.raises(InputError, match=r"log\.until: found 1\.0, expected a number above 3"):
        scenario.with_overrides({"log.from": 3.0, "log.until": 1.0})


@pytest.mark.skipif(not LABYRINTH.is_dir(), reason="the labyrinth recording is not here")
def test_labyrinth_files_become_one_log() -> None:
    """Against an oracle that reads the files with csv."""
    scenario = load_scenario(DOCS / "labyrinth.toml")
    assert len((DOCS / "labyrinth.toml").read_text().splitlines()) <= 60
    log = load_logs(scenario, [LABYRINTH / "all"])

    def rows(name: str) -> list[dict[str, str]]:
        with (LABYRINTH / f"{name}.csv").open() as file:
            return list(csv.DictReader(file))

    anchors = [row["anchor"] for row in rows("anchors")]
    stations = np.array([[float(row["x_m"]), float(row["y_m"])] for row in rows("anchors")])
    np.testing.assert_array_equal(log.inputs["range.stations"][0, 0], stations)
    for k, (reach, wheel, truth) in enumerate(
        zip(rows("ranges"), rows("wheels"), rows("truth"), strict=True)
    ):
        expected = np.full(4, np.nan)
        expected[anchors.index(reach["anchor"])] = float(reach["range_m"])
        np.testing.assert_array_equal(log.z[k, 0], expected)
        assert float(log.time[k, 0]) == float(reach["time_s"])
        assert log.inputs["left"][k, 0].item() == float(wheel["left_m_s"])
        assert log.truth is not None
        assert log.truth[k, 0].tolist() == [float(truth["x_m"]), float(truth["y_m"])]
    assert k == log.steps - 1
    parts = [load_logs(scenario, [LABYRINTH / run]).steps for run in ("first", "second")]
    assert sum(parts) == log.steps
