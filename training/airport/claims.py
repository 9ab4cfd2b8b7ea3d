"""The claims of paper 3, each judged by the numbers of this run."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import difffilter as df
from difffilter.reports.report import Report
from training.airport.paper import BASELINES, QUOTED

#: What counts as "about".
ABOUT = 0.15
#: Noise in line of sight, ns, and the mean of U(0.5, 1).
SIGMA, MEAN_SHARE = 10.0, 0.75


def judge_comparison(report: Report, name: str, table: df.Comparison) -> None:
    """Whether the published M-EKF is the best of the paper's methods, as the paper has it."""
    rows = {row.system: row for row in table.rows if row.values == "published"}
    mine = rows["m-ekf"].rmse
    errors = {system: rows[system].rmse for system in (*BASELINES, "m-ekf")}
    report.claim(
        f"paper 3, {name}: the M-EKF is more accurate than the EKF",
        rows["ekf"].ratio_ci95[0] > 1.0,
        {"m-ekf": mine, "ekf": rows["ekf"].rmse,
         "ekf / m-ekf, 95 %": rows["ekf"].ratio_ci95},
    )  # fmt: skip
    report.claim(
        f"paper 3, {name}: the M-EKF is more accurate than each of the paper's baselines",
        all(mine < errors[system] for system in BASELINES),
        errors,
    )
    share = QUOTED["m-ekf"] / QUOTED["ekf"]
    report.claim(
        f"paper 3, {name}: the M-EKF errs by at most {QUOTED['m-ekf']:g} / {QUOTED['ekf']:g} of "
        "the EKF's error, as in the paper",
        mine <= share * rows["ekf"].rmse,
        {"m-ekf / ekf": mine / rows["ekf"].rmse, "the paper": share},
    )
    if "50 ns" in name:
        _seven_against_five(report, name, rows)


def _seven_against_five(report: Report, name: str, rows: Mapping[str, Any]) -> None:
    numbers: dict[str, Any] = {f"{system}, the paper": said for system, said in QUOTED.items()}
    variants = ("ekf", "huber", "m-ekf", "m-ekf-all-rows", "m-ekf-mad")
    here = {system: rows[system].rmse for system in variants}
    report.claim(
        f"paper 3, {name}: under NLOS the EKF errs by about {QUOTED['ekf']:g} m, the M-EKF by "
        f"about {QUOTED['m-ekf']:g} m",
        all(abs(here[system] / said - 1.0) <= ABOUT for system, said in QUOTED.items()),
        numbers | {f"{system}, here": error for system, error in here.items()},
    )
    report.claim(
        f"{name}: no weighting helps, every M-EKF within 1 % of the EKF: a bias that all channels "
        "share is no outlier",
        all(abs(error / here["ekf"] - 1.0) <= 0.01 for error in here.values()),
        here,
    )


def judge_figures(
    report: Report,
    windows: Mapping[str, Any],
    noise: Mapping[str, Any],
    nlos: Mapping[str, Any],
) -> None:
    """What figures 7, 8 and 9 say, panel by panel."""
    for title, (_, curves) in windows.items():
        ratios = _ratios(curves)
        report.claim(
            f"paper 3, Figure 7, {title}: the M-EKF is below the EKF in every window",
            max(ratios) < 1.0,
            {"windows": len(ratios), "m-ekf / ekf, lowest": min(ratios), "highest": max(ratios)},
        )
    _, curves = next(iter(noise.values()))  # published filters are the same in both panels
    ratios = _ratios(curves)
    report.claim(
        "Figure 8: without NLOS the M-EKF costs at most 3 % against the EKF at every sigma",
        max(ratios) <= 1.03,
        {"m-ekf / ekf, lowest": min(ratios), "highest": max(ratios)},
    )
    for title, (levels, curves) in nlos.items():
        at = dict(zip(levels, _ratios(curves), strict=True))
        report.claim(
            f"paper 3, Figure 9, {title}: the M-EKF is below the EKF wherever the mean NLOS error "
            "exceeds the noise's sigma",
            all(ratio < 1.0 for level, ratio in at.items() if MEAN_SHARE * level > SIGMA),
            {f"m-ekf / ekf, {level:g} ns": ratio for level, ratio in at.items()},
        )


def judge_mad(report: Report, without: float, with_mad: float) -> None:
    """Whether the scale estimate of 11 residuals costs, where nothing is an outlier."""
    report.claim(
        "without NLOS the scale estimate of the step's own 11 residuals (1.48 MAD) costs accuracy",
        with_mad > without,
        {"m-ekf-mad": with_mad, "m-ekf-all-rows": without},
    )


def _ratios(curves: Mapping[str, list[float]]) -> list[float]:
    return [a / b for a, b in zip(curves["m-ekf"], curves["ekf"], strict=True)]


VARIANTS = ("huber", "m-ekf", "m-ekf-all-rows", "m-ekf-mad")


def judge(report: Report, name: str, table: df.Comparison) -> None:
    """The claims that this comparison decides."""
    tuned = table.row("m-ekf", "tuned")
    clairvoyant = table.row("clairvoyant")
    best = min((table.row(variant) for variant in VARIANTS), key=lambda row: row.rmse)
    numbers = {"tuned": tuned.rmse, f"{best.system} published": best.rmse}
    if name.startswith("intermittent"):
        held = tuned.rmse <= 0.9 * best.rmse and tuned.ratio_ci95[1] < 1.0
        numbers |= {"ratio to m-ekf published, 95 %": tuned.ratio_ci95}
        report.claim(f"{name}: tuned at least 10 % below the best published", held, numbers)
    elif "50 ns" in name:
        report.claim(
            f"{name}: tuned at most 1.3 m; the bias parameter makes it possible",
            tuned.rmse <= 1.3,
            numbers,
        )
    consistent = 0.7 <= tuned.nees_per_state <= 1.4
    report.claim(
        f"{name}: mean NEES per state of the tuned filter between 0.7 and 1.4",
        consistent,
        {"NEES per state": tuned.nees_per_state},
    )
    published = [row for row in table.rows if row.values == "published"]
    report.claim(
        f"{name}: with published noise values the clairvoyant EKF is best",
        all(clairvoyant.rmse <= row.rmse * (1 + 1e-9) for row in published),
        {"clairvoyant": clairvoyant.rmse, "best other": sorted(r.rmse for r in published)[1]},
    )
