"""What paper 3 shows and claims, and the verdicts on it.

Specification 3 quotes two numbers of the paper; all others here come from this run.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import difffilter as df
from difffilter.reports.report import Report

#: The paper's RMSE in m under NLOS.
QUOTED = {"ekf": 7.0, "m-ekf": 5.0}
#: What counts as "about".
ABOUT = 0.15
#: Noise in line of sight, ns, and the mean of U(0.5, 1).
SIGMA, MEAN_SHARE = 10.0, 0.75
#: The paper's other methods; chan-ekf is its reference [8], adaptive-ekf its reference [9].
BASELINES = ("taylor-ls", "chan-ls", "ekf", "chan-ekf", "adaptive-ekf")
#: What the paper says of its figures.
SAYS = {
    "field": "a figure of the field shows the receivers and gives no coordinates.",
    "figure 6": "Figure 6 shows a track along runway A, x = 500 m, from y = 200 m at 50 km/h. "
    "NLOS strikes every difference, N_L U(0.5, 1) ns (the literal reading).",
    "figure 7": "Figure 7 shows the RMSE in windows of 50 points over 1000.",
    "figure 8": "Figure 8 shows the RMSE against sigma, line of sight alone. The specification "
    "quotes no value of it.",
    "figure 9": f"Figure 9 shows the RMSE against N_L. Under NLOS the EKF is said to err by "
    f"{QUOTED['ekf']:g} m, the M-EKF by {QUOTED['m-ekf']:g} m.",
    "all systems": "its baselines are Taylor-series least squares, Chan's closed form, the EKF, "
    "reference [8] (chan-ekf here) and reference [9] (adaptive-ekf here).",
}
ITEMS = (
    ("figure of the field", "receivers and runways", "regenerated: field; coordinates calibrated"),
    ("Figure 6", "track", "regenerated: figure-6-track, both readings"),
    ("Figure 7", "RMSE in windows of 50 points", "regenerated: figure-7-windows, both readings"),
    ("Figure 8", "RMSE against sigma, no NLOS", "regenerated: figure-8-noise and its tables"),
    ("Figure 9", "RMSE against N_L", "regenerated: figure-9-nlos and its tables, both readings"),
    ("other figures, tables", "not described in the specification", "not regenerated"),
)
UNCHECKED = {
    "paper 3: where the receivers stand": "the paper's figure gives no coordinates; calibrated",
    "paper 3: its time step, and its clipping points a and b of eq. (25)":
        "the paper leaves them open; 0.1 s, a = 1.5 and b = 4 are calibrated",
    "paper 3: the values of the curves in Figures 6 to 9": "the specification quotes none but "
        "the EKF's and the M-EKF's error under NLOS",
    "paper 3: its tables, and its figures other than the field and 6 to 9":
        "the specification describes none",
}  # fmt: skip


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
