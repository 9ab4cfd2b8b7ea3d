"""Tables of the README and of docs/weights.md, as Markdown, from the reports' JSON."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from difffilter.files import write_atomically

__all__ = [
    "AIRPORT",
    "BEARING",
    "MANOEUVRE",
    "RUNS",
    "URBAN",
    "manoeuvre_row",
    "put",
    "results",
    "uwb_row",
    "weight_tables",
]

Rows = list[dict[str, Any]]

#: Comparisons of the airport that the README shows.
AIRPORT = ("intermittent, 100 ns, p = 0.1", "literal, 50 ns")
#: Comparisons of airborne bearings, and what the README calls them.
BEARING = {
    "outliers": "Table 1's outliers",
    "multipath": "multipath",
    "matched": "a world as assumed",
    "clean": "no outliers",
}
#: The urban comparison, and its systems and values: published, tuned, ideal.
URBAN = "held out"
URBAN_ROWS = (("credibility", "published"), ("credibility", "tuned"), ("ideal", "published"))
#: Scenarios of the manoeuvre experiment.
MANOEUVRE = {"manoeuvre-fusion-1": "turns", "manoeuvre-fusion-2": "turns, bad measurements"}
RUNS = ("los_A1", "los_A2", "nlos_A1", "nlos_A2")


def put(page: Path, name: str, text: str, script: str = "docs/make/readme.py") -> None:
    """Replace what stands between a page's two markers of that name."""
    begin, end = f"<!-- {name}: written by {script} -->", f"<!-- end of {name} -->"
    before, found, rest = page.read_text().partition(begin)
    _, closed, after = rest.partition(end)
    if not (found and closed):
        raise ValueError(f"{page}: found no markers of {name}, expected {begin} and {end}")
    write_atomically(page, f"{before}{begin}\n\n{text}\n{end}{after}")


def results(
    airport: dict[str, Any],
    bearing: dict[str, Any],
    urban: dict[str, Any],
    manoeuvre: dict[str, Rows],
    uwb: Rows,
) -> str:
    """What tuning bought: RMSE of the published, the tuned and the clairvoyant filter."""
    lines = [_compared(f"airport TDOA, {name}", airport[name], "m-ekf") for name in AIRPORT]
    lines += [
        _compared(f"airborne bearings, {label}", bearing[name], "gated")
        for name, label in BEARING.items()
    ]
    lines += _urban(urban[URBAN])
    lines += _manoeuvre(manoeuvre)
    for run in RUNS:
        hand = uwb_row(uwb, run, "hand-picked")
        tuned = uwb_row(uwb, run, "tuned: squared error and consistency")
        hand_picked = f"{_metres(hand['RMSE (m)'])} (hand-picked)"
        lines.append(
            [f"UWB {run}", hand_picked, _metres(tuned["RMSE (m)"]), "",
             f"{tuned['NEES per axis']:.2f}"]
        )  # fmt: skip
    return _table(["held out", "published", "tuned", "clairvoyant", "NEES per state, tuned"], lines)


def weight_tables(report: dict[str, Any]) -> str:
    """The tables of docs/weights.md: default clipping points, multipath, recorded ranges."""
    runs, tables = report["settings"]["runs"], report["tables"]
    parts = [
        "### At the default clipping points",
        f"Position RMSE over {runs} runs, and NEES per state with two-sided outliers (1 is right). "
        "Efficiency: mean squared error of the plain filter over that of the weight, clean data.",
        _rows(tables["published"]),
        "### Tuned on multipath",
        f"Position RMSE over {runs} held-out runs; low and high bound it with 95 %.",
        _rows(tables["multipath"]),
    ]
    if "ranges" in tables:
        parts += [
            "### Tuned on recorded ranges",
            "Horizontal RMSE and NEES per axis on the runs of the layout that a column names; "
            "tuned on those of the other layout.",
            _rows(tables["ranges"]),
        ]
    return "\n\n".join(part.rstrip("\n") for part in parts) + "\n"


def uwb_row(rows: Rows, run: str, values: str) -> dict[str, Any]:
    """The row of a run; of the two hand-picked systems, the robust one."""
    (row,) = (r for r in rows if (r["run"], r["values"]) == (run, values) and r["system"] != "ekf")
    return row


def _compared(label: str, comparison: dict[str, Any], system: str) -> list[str]:
    rows = {(row["system"], row["values"]): row for row in comparison["rows"]}
    tuned = rows[system, "tuned"]
    told = rows["clairvoyant", "published"]
    errors = [_metres(row["rmse"]) for row in (rows[system, "published"], tuned, told)]
    return [label, *errors, f"{tuned['nees_per_state']:.2f}"]


def _urban(comparison: dict[str, Any]) -> list[list[str]]:
    """A line for the whole and one for each scene; the bound is the ideal filter."""
    rows = {(row["system"], row["values"]): row for row in comparison["rows"]}
    published, tuned, ideal = (rows[key] for key in URBAN_ROWS)
    errors = {"all scenes": [row["rmse"] for row in (published, tuned, ideal)]}
    for scene in published["per_scene"]:
        errors[f"scene {scene}"] = [row["per_scene"][scene] for row in (published, tuned, ideal)]
    nees = {"all scenes": f"{tuned['nees_per_state']:.2f}"}
    return [
        [f"urban credibility, {label}", _metres(before), _metres(after),
         f"{_metres(bound)} (ideal)", nees.get(label, "")]
        for label, (before, after, bound) in errors.items()
    ]  # fmt: skip


def manoeuvre_row(tables: dict[str, Rows], scene: str, system: str) -> tuple[float, float, float]:
    """Error of the published and the tuned values, and the NEES of the tuned ones."""
    if system == "pooled-robust":
        (row,) = (r for r in tables["single"] if r["scene"] == scene)
        return row["hand-picked (m)"], row["tuned (m)"], row["NEES per state"]
    (row,) = (r for r in tables["tuned"] if (r["scene"], r["system"]) == (scene, system))
    return row["published (m)"], row["tuned (m)"], row["NEES tuned"]


def _manoeuvre(tables: dict[str, Rows]) -> list[list[str]]:
    """Fusion, the adaptive filter on one sensor, and the chain on all three as one."""
    lines = []
    shown = {"fusion": "fusion", "lcasrckf": "LCASRCKF", "pooled-robust": "chain, pooled"}
    for scene, label in MANOEUVRE.items():
        for system, name in shown.items():
            published, tuned, nees = manoeuvre_row(tables, scene, system)
            by_hand = " (hand-picked)" * (system == "pooled-robust")
            lines.append(
                [f"{label}: {name}", f"{_metres(published)}{by_hand}", _metres(tuned), "",
                 f"{nees:.2f}"]
            )  # fmt: skip
    return lines


def _rows(rows: Rows) -> str:
    return _table(list(rows[0]), [[_cell(value) for value in row.values()] for row in rows])


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _metres(value: float) -> str:
    return f"{value:.{2 if value < 10.0 else 1}f} m"


def _cell(value: Any) -> str:
    """Three significant digits."""
    if value is None:
        return ""
    if not isinstance(value, float):
        return str(value)
    return f"{value:.0f}" if abs(value) >= 100.0 else f"{value:#.3g}"
