"""Writes the pictures and tables of the README and of docs/weights.md from the reports.

python training/readme.py            # after make reproduce
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from docs_tables import AIRPORT, BEARING, RUNS, URBAN, put, results, uwb_row, weight_tables
from matplotlib.axes import Axes

from difffilter.figures.style import COLOURS, axes_grid, save_figure
from difffilter.figures.weights import weights_figure

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
NAMES = ("airport-mlat", "airborne-bearing", "urban-credibility", "uwb-ranges", "weights")


def main() -> int:
    """Pictures and tables; exit 2 where a report is missing or was a quick run."""
    reports = {}
    for name in NAMES:
        path = ROOT / "report" / name / "report.json"
        if not path.is_file():
            print(f"{path}: found no report, expected the one of make reproduce", file=sys.stderr)
            return 2
        reports[name] = json.loads(path.read_text())
        if reports[name]["settings"]["quick"]:
            print(f"{path}: found a quick run, expected a full one", file=sys.stderr)
            return 2
    airport = reports["airport-mlat"]["comparisons"]
    bearing = reports["airborne-bearing"]["comparisons"]
    urban = reports["urban-credibility"]["comparisons"]
    uwb = reports["uwb-ranges"]["tables"]["held-out runs"]
    figure, axes = axes_grid(2, 2, width=6.2, height=3.8)
    draw_airport(axes[0], airport[AIRPORT[0]]["rows"])
    draw_bearing(axes[1], bearing)
    draw_urban(axes[2], urban[URBAN]["rows"])
    draw_uwb(axes[3], uwb)
    save_figure(figure, IMAGES / "results")
    save_figure(weights_figure(), IMAGES / "weights")
    put(ROOT / "README.md", "results", results(airport, bearing, urban, uwb))
    put(ROOT / "docs" / "weights.md", "weights", weight_tables(reports["weights"]))
    return 0


def draw_airport(ax: Axes, rows: list[dict[str, Any]]) -> None:
    """A bar per system and values, the best at the top."""
    rows = sorted(rows, key=lambda row: -row["rmse"])
    names = [f"{row['system']}{' (tuned)' if row['values'] == 'tuned' else ''}" for row in rows]
    colours = [
        COLOURS["tuned"] if row["values"] == "tuned" else COLOURS["clairvoyant"]
        if row["system"] == "clairvoyant" else COLOURS["published"]
        for row in rows
    ]  # fmt: skip
    bars = ax.barh(names, [row["rmse"] for row in rows], color=colours)
    ax.bar_label(bars, fmt="%.2f", fontsize=8, padding=2)
    ax.set(xlabel="position RMSE (m), held out", title="Airport TDOA, 10 % of differences NLOS")


def draw_bearing(ax: Axes, comparisons: dict[str, Any]) -> None:
    """Four points per world, on a logarithmic scale."""
    series = (
        ("EKF", "ekf", "published", COLOURS["other"]),
        ("gated, published", "gated", "published", COLOURS["published"]),
        ("gated, tuned", "gated", "tuned", COLOURS["tuned"]),
        ("clairvoyant", "clairvoyant", "published", COLOURS["clairvoyant"]),
    )
    for i, (label, system, values, colour) in enumerate(series):
        heights = [
            next(
                row["rmse"]
                for row in comparisons[name]["rows"]
                if (row["system"], row["values"]) == (system, values)
            )
            for name in BEARING
        ]
        places = [x + 0.16 * (i - 1.5) for x in range(len(BEARING))]
        ax.plot(places, heights, "o", ms=8, label=label, color=colour)
    ax.set_xticks(range(len(BEARING)), BEARING)
    ax.set(yscale="log", ylim=(5.0, 600.0), ylabel="position RMSE (m), held out")
    ticks = (5, 10, 20, 50, 100, 200)
    ax.set_yticks(ticks, [str(tick) for tick in ticks])
    ax.set_yticks([], minor=True)
    ax.set_title("Airborne bearings")
    ax.legend(fontsize=8, ncols=2, loc="upper center")


def draw_urban(ax: Axes, rows: list[dict[str, Any]]) -> None:
    """Four bars per scene."""
    series = (
        ("standard (algorithm 1)", "standard", "published", COLOURS["other"]),
        ("credibility (2), published", "credibility", "published", COLOURS["published"]),
        ("credibility (2), tuned", "credibility", "tuned", COLOURS["tuned"]),
        ("ideal (3), not realisable", "ideal", "published", COLOURS["clairvoyant"]),
    )
    by_name = {(row["system"], row["values"]): row["per_scene"] for row in rows}
    scenes = list(rows[0]["per_scene"])
    for i, (label, system, values, colour) in enumerate(series):
        heights = [by_name[system, values][scene] for scene in scenes]
        places = [x + 0.2 * (i - 1.5) for x in range(len(scenes))]
        ax.bar(places, heights, 0.18, label=label, color=colour)
    ax.set_xticks(range(len(scenes)), [f"scene {scene}" for scene in scenes])
    ax.set(ylabel="position RMSE (m), held out", title="Urban credibility, two systems")
    ax.legend(fontsize=8)


def draw_uwb(ax: Axes, rows: list[dict[str, Any]]) -> None:
    """Three bars per recorded run."""
    series = (
        ("ESKF with IMU (data's authors)", "published", COLOURS["other"]),
        ("hand-picked", "hand-picked", COLOURS["published"]),
        ("tuned", "tuned: squared error and consistency", COLOURS["tuned"]),
    )
    for i, (label, key, colour) in enumerate(series):
        heights = [uwb_row(rows, run, key)["RMSE (m)"] for run in RUNS]
        ax.bar([x + 0.27 * (i - 1) for x in range(4)], heights, 0.25, label=label, color=colour)
    ax.set_xticks(range(4), RUNS)
    ax.set(ylabel="horizontal RMSE (m), held out", title="Recorded UWB ranges, run left out")
    ax.legend(fontsize=8)


if __name__ == "__main__":
    sys.exit(main())
