"""The claims of paper 1, each judged by the numbers of this run, in metres."""

from __future__ import annotations

from typing import Any

from torch import Tensor

import difffilter as df
from difffilter.reports.report import Report
from training.bearing.paper import QUOTED
from training.bearing.tables import Curves

#: Level whose crossing tells when a filter has converged, m.
CONVERGED = 20.0


def late(curve: Tensor, first: int = 50, last: int = 200) -> float:
    """RMSE over seconds first to last."""
    return float(curve[first - 1 : last].square().mean().sqrt())


def judge_paper(report: Report, without: Curves, outliers: Curves) -> None:
    """The paper's claims, in metres."""
    clean, wild = without.median, outliers.median
    ekf, robust, gated = (late(clean[name]) for name in ("ekf", "robust", "gated"))
    ls, weighted = late(clean["ls"]), late(clean["weighted-ls"])
    report.claim(
        "paper 1: the EKF beats least squares in accuracy (no outliers)",
        ekf < min(ls, weighted),
        {"ekf": ekf, "ls": ls, "weighted ls": weighted},
    )
    report.claim(
        "paper 1: without outliers the robust EKF is a little worse than the EKF (about 20 m), "
        "the gated one close to it (3 m)",
        0.0 < robust - ekf < 25.0 and abs(gated - ekf) < 3.0,
        {"robust - ekf (m)": robust - ekf, "gated - ekf (m)": gated - ekf,
         "robust - ekf at 10 s": float(clean["robust"][9] - clean["ekf"][9])},
    )  # fmt: skip
    cost = {f"{k} s": float(wild["ekf"][k - 1] - clean["ekf"][k - 1]) for k in (111, 131, 141, 161)}
    report.claim(
        "paper 1: the outliers cost the EKF about 100 m from 100 s on, and hundreds after the "
        "single ones",
        cost["111 s"] > 50.0 and cost["161 s"] > 200.0,
        cost,
    )
    moved = {
        name: float((wild[name] - clean[name])[99:].abs().max()) for name in ("robust", "gated")
    }
    report.claim(
        "paper 1: both robust filters hardly move",
        all(metres < 10.0 for metres in moved.values()),
        {f"{name}, most (m)": metres for name, metres in moved.items()},
    )
    slow = {
        name: int((clean[name][:100] > 100.0).sum()) for name in ("ekf", "robust", "robust-noise")
    }
    report.claim(
        "paper 1: the robust EKF converges more slowly (standardised by the noise alone)",
        slow["robust-noise"] > slow["ekf"],
        {f"{name}: seconds above 100 m": seconds for name, seconds in slow.items()},
    )


def judge_more(report: Report, without: Curves, outliers: Curves) -> None:
    """The rest of them."""
    clean, wild = without.median, outliers.median
    ahead = {
        f"{name} - ekf, {world} (m)": late(curves[name]) - late(curves["ekf"])
        for world, curves in (("no outliers", clean), ("outliers", wild))
        for name in ("ls", "weighted-ls")
    }
    report.claim(
        f"paper 1: the EKF is better than least squares by about {QUOTED['ls - ekf']:g} m "
        "(no outliers)",
        abs(ahead["ls - ekf, no outliers (m)"] / QUOTED["ls - ekf"] - 1.0) <= 0.5,
        ahead | {"why": "the emitter stands still: process noise only costs the filter"},
    )
    settled = {name: _settled(clean[name]) for name in ("ekf", "ls", "weighted-ls")}
    report.claim(
        "paper 1: the EKF beats least squares in convergence (no outliers)",
        settled["ekf"] < min(settled["ls"], settled["weighted-ls"]),
        {f"{name}: below {CONVERGED:g} m from (s)": second for name, second in settled.items()},
    )
    literal = {
        f"robust-noise - ekf, {first} to {last} s (m)": late(clean["robust-noise"], first, last)
        - late(clean["ekf"], first, last)
        for first, last in ((50, 200), (100, 200), (150, 200))
    }
    report.claim(
        f"paper 1: without outliers the robust EKF is about {QUOTED['robust - ekf']:g} m worse "
        "than the EKF (standardised by the noise alone, over 100 to 200 s, while it still "
        "converges: other seconds give other differences)",
        abs(literal["robust-noise - ekf, 100 to 200 s (m)"] / QUOTED["robust - ekf"] - 1.0) <= 0.5,
        literal,
    )
    both = {name: late(wild[name], 101) for name in ("ekf", "robust", "gated", "robust-noise")}
    report.claim(
        "paper 1: with outliers both robust filters are more accurate than the EKF (101 to 200 s)",
        max(both["robust"], both["gated"]) < both["ekf"],
        both,
    )


def _settled(curve: Tensor, last: int = 95) -> int:
    """The first second from which the curve stays below the level, up to ``last``."""
    above = (curve[:last] > CONVERGED).nonzero()
    return int(above.max()) + 2 if len(above) else 1


def judge(report: Report, key: str, table: df.Comparison) -> None:
    """The claims that a comparison decides."""
    tuned, published = table.row("gated", "tuned"), table.row("gated")
    told = table.row("clairvoyant")
    numbers: dict[str, Any] = {
        "tuned": tuned.rmse, "published": published.rmse, "clairvoyant": told.rmse,
        "ratio, 95 %": tuned.ratio_ci95,
    }  # fmt: skip
    if key == "outliers":
        held = tuned.rmse <= 0.6 * published.rmse and tuned.ratio_ci95[1] < 1.0
        report.claim("Table 1: tuned at most 60 % of the published gated filter", held, numbers)
    elif key == "multipath":
        held = tuned.rmse <= 0.8 * published.rmse and tuned.ratio_ci95[1] < 1.0
        held = held and tuned.rmse <= 1.08 * told.rmse
        numbers["tuned without bias"] = table.row("gated", "tuned without bias").rmse
        report.claim(
            "multipath: tuned at most 80 % of the published gated filter, and within 8 % of the "
            "clairvoyant with matched noise",
            held,
            numbers,
        )
    elif key == "clean":
        ekf = table.row("ekf", "tuned ekf")
        other = table.row("gated", "tuned on outliers")
        report.claim(
            "no outliers: the tuned filter loses at most 3 % to the tuned EKF",
            tuned.rmse <= 1.03 * ekf.rmse and other.rmse <= 1.03 * ekf.rmse,
            {"tuned": tuned.rmse, "tuned on Table 1's outliers": other.rmse, "ekf": ekf.rmse},
        )
    else:
        report.claim(
            "matched: the published filter is within 1 % of the clairvoyant, so that tuning has "
            "nothing to win",
            published.rmse <= 1.01 * told.rmse,
            numbers,
        )
