"""Writes the pictures and tables of the README and of docs/weights.md from the reports.

python -m docs.make.readme            # after make reproduce
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from difffilter.reports.figures.style import COLOURS, axes_grid, save_figure
from difffilter.reports.figures.weights import weights_figure
from docs.make.docs_tables import (
    AIRPORT,
    BEARING,
    MANOEUVRE,
    RUNS,
    URBAN,
    manoeuvre_row,
    put,
    results,
    uwb_row,
    weight_tables,
)

ROOT = Path(__file__).resolve().parents[2]
IMAGES = ROOT / "docs" / "images"
NAMES = (
    "airport-mlat",
    "airborne-bearing",
    "urban-credibility",
    "manoeuvre-fusion",
    "uwb-ranges",
    "weights",
)


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
    manoeuvre = reports["manoeuvre-fusion"]["tables"]
    figure, axes = axes_grid(3, 2, width=6.2, height=3.8)
    draw_airport(axes[0], airport[AIRPORT[0]]["rows"])
    draw_bearing(axes[1], bearing)
    draw_urban(axes[2], urban[URBAN]["rows"])
    draw_uwb(axes[3], uwb)
    draw_manoeuvre(axes[4], manoeuvre)
    draw_equal_terms(axes[5], manoeuvre["equal terms"])
    save_figure(figure, IMAGES / "results")
    save_figure(weights_figure(), IMAGES / "weights")
    put(ROOT / "README.md", "results", results(airport, bearing, urban, manoeuvre, uwb))
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


def draw_manoeuvre(ax: Axes, tables: dict[str, list[dict[str, Any]]]) -> None:
    """Published and tuned values of three filters in both scenes."""
    names = {
        "lcasrckf": "LCASRCKF, one sensor",
        "pooled-robust": "chain, three as one",
        "fusion": "fusion, three sensors",
    }
    pairs = {}
    for scene, label in MANOEUVRE.items():
        for system, name in names.items():
            pairs[f"{label}:\n{name}"] = manoeuvre_row(tables, scene, system)[:2]
    series = (("published or hand-picked", COLOURS["published"]), ("tuned", COLOURS["tuned"]))
    _dumbbells(ax, pairs, series)
    ax.set_title("Manoeuvres and bad measurements")


def draw_equal_terms(ax: Axes, rows: list[dict[str, Any]]) -> None:
    """Every filter on all three sensors: clean measurements against bad ones."""
    pairs = {}
    for row in rows:
        clean, bad = ((row[f"scene {n} x"] + row[f"scene {n} y"]) / 2.0 for n in (1, 2))
        name = row["system"].removesuffix(" (pooled)")
        pairs["chain" if name == "pooled-robust" else name] = (clean, bad)
    series = (("turns", COLOURS["other"]), ("turns, bad measurements", COLOURS["published"]))
    _dumbbells(ax, pairs, series)
    ax.set_title("The same, all on three sensors, before tuning")


def _dumbbells(
    ax: Axes, pairs: dict[str, tuple[float, float]], series: tuple[tuple[str, str], ...]
) -> None:
    """Two points per row, joined, on a logarithmic scale."""
    for place, (one, two) in enumerate(pairs.values()):
        ax.plot((one, two), (place, place), "-", color=COLOURS["other"], lw=1.0)
        right = max(one, two)
        ax.text(right * 1.09, place, f"{right:.3g}", fontsize=8, va="center")
        ax.text(min(one, two) / 1.09, place, f"{min(one, two):.3g}", fontsize=8, va="center",
                ha="right")  # fmt: skip
    for i, (label, colour) in enumerate(series):
        values = [pair[i] for pair in pairs.values()]
        ax.plot(values, range(len(values)), "o", ms=7, label=label, color=colour)
    ax.set_yticks(range(len(pairs)), list(pairs), fontsize=8)
    ax.set(xscale="log", xlim=(2.5, 150.0), xlabel="RMSE of x and y, mean over time (m), held out")
    ax.set_xticks((5, 10, 20, 50, 100), ("5", "10", "20", "50", "100"))
    ax.set_xticks([], minor=True)
    ax.set_ylim(-0.6, len(pairs) + 0.3)
    ax.legend(fontsize=8, ncols=2, loc="upper center")


if __name__ == "__main__":
    sys.exit(main())
