"""Figure 6 of the airport experiment, tracks, and the field that they lie in."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import difffilter as df
from difffilter.reports.figures.style import COLOURS, axes_grid
from difffilter.reports.figures.tracks import track_figure
from difffilter.reports.report import Report
from training.airport.paper import SAYS
from training.airport.tables import WORLDS

FIELD = (
    "The field: receivers and runway A, 8 receivers, number 1 the reference; coordinates are "
    "calibrated; one trajectory of 100 steps, no filter"
)


def field_figure(report: Report, scenario: df.Scenario, log: df.Log) -> None:
    """Receivers, the runway and a true track."""
    assert log.truth is not None
    figure, (ax,) = axes_grid(1, 1, width=4.6, height=5.6)
    stations = scenario.document["sensors"]["tdoa"]["stations"]
    for number, (x, y) in enumerate(stations, start=1):
        ax.plot(x, y, "^", color=COLOURS["published"], ms=8)
        ax.annotate(f"{number}", (x, y), xytext=(6, 4), textcoords="offset points", fontsize=8)
    ax.axvline(500.0, color=COLOURS["other"], lw=5.0, alpha=0.4, label="runway A")
    ax.plot(*log.truth[:, 0, :2].T, color=COLOURS["truth"], lw=2.5, label="truth")
    ax.set(xlabel="x (m)", ylabel="y (m)", aspect="equal")
    ax.legend(fontsize=8)
    report.figure(figure, "field", FIELD, SAYS["field"])


def tracks_figure(
    report: Report,
    worlds: Mapping[str, df.Scenario],
    tuned: Mapping[str, df.Checkpoint],
    seed: int,
) -> None:
    """Figure 6: one trajectory of each reading, and the errors and weights of the second."""
    figure, axes = axes_grid(1, len(worlds), width=6.4, height=4.2)
    for ax, (title, scenario) in zip(axes, worlds.items(), strict=True):
        log = df.simulate(scenario, 1, seed + 3, "figure")
        assert log.truth is not None
        frozen = tuned[WORLDS[title]]
        tracks = {
            name: df.estimate(scenario.system(name), log) for name in ("taylor-ls", "ekf", "m-ekf")
        }
        tracks["m-ekf tuned"] = df.run(frozen.filter, log)
        looks: tuple[dict[str, Any], ...] = (
            {"marker": ".", "ls": "", "ms": 4, "color": COLOURS["other"]},
            {"color": "#CC79A7"}, {"color": COLOURS["published"]}, {"color": COLOURS["tuned"]},
        )  # fmt: skip
        for (name, track), look in zip(tracks.items(), looks, strict=True):
            across, along = track.mean[:, 0, :2].T
            ax.plot(along, across, label=name, lw=1.4, **look)
        ax.plot(log.truth[:, 0, 1], log.truth[:, 0, 0], color=COLOURS["truth"], label="truth")
        ax.set(title=title, xlabel="y, along the runway (m)", ylabel="x, across (m)")
        ax.legend(fontsize=7)
    field_figure(report, scenario, log)
    report.figure(
        figure,
        "figure-6-track",
        "Figure 6: one trajectory of 100 steps per reading; published values, and the M-EKF's "
        "tuned ones (tuned on the panel's world)",
        SAYS["figure 6"],
    )
    caption = "Figure 6, intermittent, errors and weights: one trajectory, tuned M-EKF"
    report.figure(track_figure(log, track, 0, caption), "figure-6-weights", caption)
