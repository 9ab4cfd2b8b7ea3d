"""What paper 1 shows: its quoted numbers, its items and what it leaves open."""

from __future__ import annotations

#: Differences of position RMSE that the paper states, m, and its Monte Carlo runs.
QUOTED = {"ls - ekf": 150.0, "robust - ekf": 20.0, "gated - ekf": 3.0, "outliers": 100.0}
RUNS = 200
_CLEAN = (
    f"{RUNS} runs, no outliers: the robust EKF about {QUOTED['robust - ekf']:g} m worse than the "
    f"EKF, the gated one about {QUOTED['gated - ekf']:g} m."
)
_WILD = (
    f"{RUNS} runs: from 100 s on the outliers cost the EKF about {QUOTED['outliers']:g} m, "
    "hundreds after 130, 140 and 160 s, while both robust filters hardly move."
)
#: What the paper says of its figures and tables.
SAYS = {
    "table 1": "Table 1, the same.",
    "figure 2": f"Figure 2, {RUNS} runs: the EKF beats least squares in accuracy, by about "
    f"{QUOTED['ls - ekf']:g} m, and in convergence.",
    "figure 3": f"Figure 3, {_CLEAN} It reports a slower convergence of the robust EKF, which "
    "the standardisation by the noise alone shows (robust-noise).",
    "figure 4": f"Figure 4, {_WILD}",
    "curves, airborne-bearing-clean": f"Figures 2 and 3, {_CLEAN} The rows reference are "
    "computed independently, with a calibrated acceleration noise; they are not the paper's.",
    "curves, airborne-bearing": f"Figure 4, {_WILD} The rows reference are computed "
    "independently, with a calibrated acceleration noise; they are not the paper's.",
}
ITEMS = (
    ("Table 1", "outliers", "regenerated: table 1"),
    ("Figure 2", "EKF against least squares", "regenerated: figure-2 and its table"),
    ("Figure 3", "no outliers", "regenerated: figure-3 and its table"),
    ("Figure 4", "outliers", "regenerated: figure-4 and its table"),
    ("eqs. (3), (10)", "derivative of the bearing, innovation covariance", "both checked"),
    ("other figures, tables", "nothing here to compare with", "not regenerated"),
)
UNCHECKED = {
    "paper 1: its acceleration noise": "the paper gives none; 0.1 m/s^2 is calibrated, since "
        "with 0 its claims about outliers do not come out",
    "paper 1: how many bearings its start takes": "the paper gives no number; 6 is calibrated",
    "paper 1: the values of the curves in Figures 2 to 4":
        "the paper is known here by differences alone",
    "paper 1: its other figures and tables": "nothing here to compare with",
}  # fmt: skip
