"""Figures 7 to 9 of the airport experiment, for both readings of NLOS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

import difffilter as df
from difffilter.reports.figures.curves import curves_figure
from difffilter.reports.report import Report
from difffilter.scoring.metrics import position_error
from training.airport.paper import SAYS
from training.airport.tables import WORLDS, nlos

#: Panels of a figure: title to x values and a curve per system.
Panels = dict[str, tuple[Any, dict[str, list[float]]]]

SHOWN = ("taylor-ls", "chan-ls", "ekf", "chan-ekf", "adaptive-ekf", "huber", "m-ekf", "clairvoyant")
EMPHASISED = ("m-ekf", "m-ekf tuned", "clairvoyant")
READINGS = {"literal (every difference)": 1.0, "intermittent (p = 0.1)": 0.1}


def windows_figure(
    report: Report,
    worlds: Mapping[str, df.Scenario],
    tuned: Mapping[str, df.Checkpoint],
    seed: int,
    quick: bool,
) -> Panels:
    """Figure 7: RMSE in windows of 50 points along 1000 steps."""
    panels: Panels = {}
    steps, trajectories = (200, 10) if quick else (1000, 50)
    for title, base in worlds.items():
        scenario = base.with_overrides({"world.steps": steps})
        log = df.simulate(scenario, trajectories, seed + 4, "windows")
        curves = {name: _windows(log, df.estimate(scenario.system(name), log)) for name in SHOWN}
        curves["m-ekf tuned"] = _windows(log, df.run(tuned[WORLDS[title]].filter, log))
        panels[title] = ([25 + 50 * i for i in range(len(curves["ekf"]))], curves)
    figure = curves_figure(
        panels, "step", "RMSE in a window of 50 steps (m)", log=True, emphasised=EMPHASISED
    )
    caption = (
        f"Figure 7: RMSE in windows of 50 points along {steps} steps, {trajectories} trajectories; "
        "published values, and the M-EKF's tuned ones (tuned on the panel's world)"
    )
    report.figure(figure, "figure-7-windows", caption, SAYS["figure 7"])
    return panels


def _windows(log: df.Log, track: df.Track) -> list[float]:
    squared = position_error(log, track).detach()
    blocks = squared.reshape(-1, 50, squared.shape[-1])
    return torch.sqrt(blocks.mean((1, 2))).tolist()


def sweep_noise(
    report: Report,
    scenario: df.Scenario,
    tuned: Mapping[str, df.Checkpoint],
    seed: int,
    trajectories: int,
    quick: bool,
) -> Panels:
    """Figure 8: RMSE against the noise in line of sight; published filters are told it."""
    levels = (5.0, 20.0) if quick else (5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
    settings = [
        nlos(0, 0.0) | {"sensors.tdoa.noise.sigma": s, "parameters.tdoa.sigma.value": s}
        for s in levels
    ]
    panels: Panels = {
        title: (levels, _curves(scenario, settings, _of(tuned, title), trajectories, seed))
        for title in READINGS
    }
    caption = (
        f"Figure 8: RMSE against noise without NLOS, {trajectories} trajectories per point; "
        "published values, except that they are told sigma; the tuned M-EKF, tuned "
        "at 10 ns with the NLOS of the panel, is not told it"
    )
    _sweep(report, "figure-8-noise", "noise sigma (ns)", panels, caption, log=False)
    return panels


def sweep_nlos(
    report: Report,
    scenario: df.Scenario,
    tuned: Mapping[str, df.Checkpoint],
    seed: int,
    trajectories: int,
    quick: bool,
) -> Panels:
    """Figure 9: RMSE against N_L, each reading."""
    levels = (0.0, 50.0, 100.0) if quick else (0.0, 5.0, 10.0, 25.0, 50.0, 75.0, 100.0, 150.0)
    panels: Panels = {}
    for title, p in READINGS.items():
        settings = [nlos(level, p) for level in levels]
        panels[title] = (levels, _curves(scenario, settings, _of(tuned, title), trajectories, seed))
    caption = (
        f"Figure 9: RMSE against the NLOS error, {trajectories} trajectories per point; "
        "published values, and the M-EKF tuned at one level alone: literal at 50 ns, intermittent "
        "at 100 ns. A tuned bias holds for the level that it was tuned at, and costs elsewhere."
    )
    _sweep(report, "figure-9-nlos", "N_L (ns)", panels, caption, log=True)
    return panels


def _sweep(
    report: Report,
    name: str,
    xlabel: str,
    panels: Mapping[str, tuple[Any, Mapping[str, list[float]]]],
    caption: str,
    log: bool,
) -> None:
    """A figure of RMSE curves and the same as tables."""
    figure = curves_figure(panels, xlabel, "RMSE (m)", log=log, emphasised=EMPHASISED)
    number = " ".join(name.split("-")[:2])
    report.figure(figure, name, caption, SAYS[number])
    for title, (x, curves) in panels.items():
        report.text(f"{number.capitalize()}, {title}: RMSE in m.")
        rows = [[level, *(y[i] for y in curves.values())] for i, level in enumerate(x)]
        report.table(f"{number}, {title}", [xlabel, *curves], rows)


def _of(tuned: Mapping[str, df.Checkpoint], title: str) -> df.Checkpoint:
    key = "literal, 50 ns" if title.startswith("literal") else "intermittent, 100 ns, p = 0.1"
    return tuned[key]


def _curves(
    scenario: df.Scenario,
    settings: list[dict[str, Any]],
    frozen: df.Checkpoint,
    trajectories: int,
    seed: int,
) -> dict[str, list[float]]:
    curves: dict[str, list[float]] = {name: [] for name in (*SHOWN, "m-ekf tuned")}
    for overrides in settings:
        world = scenario.with_overrides(overrides)
        values = {"published": None, "tuned": frozen}
        table = df.compare(world, values, trajectories, seed + 5, systems=SHOWN)
        for row in table.rows:
            label = row.system if row.values == "published" else f"{row.system} tuned"
            curves[label].append(row.rmse)
    return curves
