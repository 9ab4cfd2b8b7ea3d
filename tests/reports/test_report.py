"""Reports hold what was found, whole in JSON and readable in Markdown."""

import json
import math
from pathlib import Path

from matplotlib.figure import Figure

import difffilter as df
from difffilter.reports.figures.curves import curves_figure
from difffilter.reports.report import Report


def test_tables_keep_full_precision_in_json_and_show_three_decimals(tmp_path: Path) -> None:
    report = Report(tmp_path, "title", {"seed": 3})
    report.table("errors", ["system", "RMSE (m)"], [["ekf", 1.23456789], ["ls", math.nan]])
    text = report.write().read_text()
    data = json.loads((tmp_path / "report.json").read_text())
    assert "| ekf | 1.235 |" in text
    assert "| ls |  |" in text
    assert data["tables"]["errors"][0] == {"system": "ekf", "RMSE (m)": 1.23456789}
    assert data["tables"]["errors"][1]["RMSE (m)"] is None
    assert data["settings"] == {"seed": 3}


def test_a_claim_that_did_not_hold_is_shown_as_such(tmp_path: Path) -> None:
    report = Report(tmp_path, "title")
    report.claim("smaller", False, {"got": 2.0, "asked": 1.0})
    text = report.write().read_text()
    assert "| smaller | **not held** | got: 2.000, asked: 1.000 |" in text
    assert json.loads((tmp_path / "report.json").read_text())["claims"][0]["held"] is False


def test_figures_are_written_as_png_and_svg_and_shown_in_the_text(tmp_path: Path) -> None:
    report = Report(tmp_path, "title")
    panels = {"left": ([1.0, 2.0], {"ekf": [3.0, 2.0], "m-ekf tuned": [1.0, 1.5]})}
    figure = curves_figure(panels, "noise (ns)", "RMSE (m)", emphasised=("m-ekf tuned",))
    assert isinstance(figure, Figure)
    report.figure(figure, "curves", "RMSE against noise")
    assert "![RMSE against noise](curves.png)" in report.write().read_text()
    assert (tmp_path / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert "</svg>" in (tmp_path / "curves.svg").read_text()


def test_comparisons_enter_the_json_with_every_row(tmp_path: Path) -> None:
    scenario = df.load_scenario("airport-mlat", {"world.steps": 5})
    comparison = df.compare(scenario, None, 4, systems=("ekf", "clairvoyant"))
    report = Report(tmp_path, "title")
    report.comparison("small", comparison)
    report.write()
    rows = json.loads((tmp_path / "report.json").read_text())["comparisons"]["small"]["rows"]
    assert [row["system"] for row in rows] == ["ekf", "clairvoyant"]
    assert rows[0]["rmse"] == comparison.row("ekf").rmse
