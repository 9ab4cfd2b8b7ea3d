"""What paper 3 shows: its quoted numbers, its items and what it leaves open.

Two numbers are quoted of the paper; all others come from the run.
"""

from __future__ import annotations

#: The paper's RMSE in m under NLOS.
QUOTED = {"ekf": 7.0, "m-ekf": 5.0}
#: The paper's other methods; chan-ekf is its reference [8], adaptive-ekf its reference [9].
BASELINES = ("taylor-ls", "chan-ls", "ekf", "chan-ekf", "adaptive-ekf")
#: What the paper says of its figures.
SAYS = {
    "field": "a figure of the field shows the receivers and gives no coordinates.",
    "figure 6": "Figure 6 shows a track along runway A, x = 500 m, from y = 200 m at 50 km/h. "
    "NLOS strikes every difference, N_L U(0.5, 1) ns (the literal reading).",
    "figure 7": "Figure 7 shows the RMSE in windows of 50 points over 1000.",
    "figure 8": "Figure 8 shows the RMSE against sigma, line of sight alone. No value of it "
    "is quoted here.",
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
    ("other figures, tables", "nothing here to compare with", "not regenerated"),
)
UNCHECKED = {
    "paper 3: where the receivers stand": "the paper's figure gives no coordinates; calibrated",
    "paper 3: its time step, and its clipping points a and b of eq. (25)":
        "the paper leaves them open; 0.1 s, a = 1.5 and b = 4 are calibrated",
    "paper 3: the values of the curves in Figures 6 to 9": "known here are only "
        "the EKF's and the M-EKF's error under NLOS",
    "paper 3: its tables, and its figures other than the field and 6 to 9":
        "nothing here to compare with",
}  # fmt: skip
