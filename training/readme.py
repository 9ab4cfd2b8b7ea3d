"""Writes the README's picture and results from the reports of ``make reproduce``.

python training/readme.py            # after make reproduce
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from difffilter.figures.style import COLOURS, axes_grid, save_figure
from difffilter.files import write_atomically

ROOT = Path(__file__).resolve().parent.parent
BEGIN, END = "<!-- results: written by training/readme.py -->", "<!-- end of results -->"
INTERMITTENT, LITERAL = "intermittent, 100 ns, p = 0.1", "literal, 50 ns"
RUNS = ("los_A1", "los_A2", "nlos_A1", "nlos_A2")


def main() -> int:
    """Picture and table; exit 2 where a report is missing or was a quick run."""
    reports = {}
    for name in ("airport-mlat", "uwb-ranges"):
        path = ROOT / "report" / name / "report.json"
        if not path.is_file():
            print(f"{path}: found no report, expected the one of make reproduce", file=sys.stderr)
            return 2
        reports[name] = json.loads(path.read_text())
        if reports[name]["settings"]["quick"]:
            print(f"{path}: found a quick run, expected a full one", file=sys.stderr)
            return 2
    airport = reports["airport-mlat"]["comparisons"]
    uwb = reports["uwb-ranges"]["tables"]["held-out runs"]
    draw(airport[INTERMITTENT]["rows"], uwb)
    readme = ROOT / "README.md"
    before, _, rest = readme.read_text().partition(BEGIN)
    _, _, after = rest.partition(END)
    text = f"{before}{BEGIN}\n{results(airport, uwb)}{END}{after}"
    write_atomically(readme, text)
    return 0


def draw(rows: list[dict[str, Any]], uwb: list[dict[str, Any]]) -> None:
    """RMSE bars: the airport's systems, and the recorded runs."""
    figure, (left, right) = axes_grid(1, 2, width=6.0, height=3.8)
    names = [f"{row['system']}{' (tuned)' if row['values'] == 'tuned' else ''}" for row in rows]
    colours = [
        COLOURS["tuned"] if row["values"] == "tuned" else COLOURS["clairvoyant"]
        if row["system"] == "clairvoyant" else COLOURS["published"]
        for row in rows
    ]  # fmt: skip
    order = sorted(range(len(rows)), key=lambda i: -rows[i]["rmse"])
    values = [rows[i]["rmse"] for i in order]
    bars = left.barh([names[i] for i in order], values, color=[colours[i] for i in order])
    left.bar_label(bars, fmt="%.2f", fontsize=8, padding=2)
    left.set(xlabel="position RMSE (m), held out", title="Airport TDOA, 10 % of differences NLOS")
    right.set(ylabel="horizontal RMSE (m), held out", title="Recorded UWB ranges, run left out")
    series = (
        ("ESKF with IMU (data's authors)", "published", COLOURS["other"]),
        ("hand-picked", "hand-picked", COLOURS["published"]),
        ("tuned", "tuned: squared error and consistency", COLOURS["tuned"]),
    )
    for i, (label, key, colour) in enumerate(series):
        heights = [_uwb(uwb, run, key)["RMSE (m)"] for run in RUNS]
        right.bar([x + 0.27 * (i - 1) for x in range(4)], heights, 0.25, label=label, color=colour)
    right.set_xticks(range(4), RUNS)
    right.legend(fontsize=8)
    save_figure(figure, ROOT / "docs" / "images" / "results")


def results(airport: dict[str, Any], uwb: list[dict[str, Any]]) -> str:
    """The table of what tuning bought."""
    lines = [
        "",
        "| held out | published | tuned | clairvoyant | NEES per state, tuned |",
        "|---|---|---|---|---|",
    ]
    for name in (INTERMITTENT, LITERAL):
        rows = {(row["system"], row["values"]): row for row in airport[name]["rows"]}
        published, tuned = rows["m-ekf", "published"], rows["m-ekf", "tuned"]
        told = rows["clairvoyant", "published"]
        lines.append(
            f"| airport TDOA, {name} | {published['rmse']:.2f} m | {tuned['rmse']:.2f} m | "
            f"{told['rmse']:.2f} m | {tuned['nees_per_state']:.2f} |"
        )
    for run in RUNS:
        hand, tuned = (
            _uwb(uwb, run, key) for key in ("hand-picked", "tuned: squared error and consistency")
        )
        lines.append(
            f"| UWB {run} | {hand['RMSE (m)']:.2f} m (hand-picked) | {tuned['RMSE (m)']:.2f} m | "
            f"| {tuned['NEES per axis']:.2f} |"
        )
    return "\n".join(lines) + "\n\n"


def _uwb(rows: list[dict[str, Any]], run: str, values: str) -> dict[str, Any]:
    """The row of a run; of the two hand-picked systems, the robust one."""
    (row,) = (r for r in rows if (r["run"], r["values"]) == (run, values) and r["system"] != "ekf")
    return row


if __name__ == "__main__":
    sys.exit(main())
