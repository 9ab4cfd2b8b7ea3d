"""The world of a log in one picture: where things are, and how wrong measurements get."""

from __future__ import annotations

import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from torch import Tensor

from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.reports.figures.style import COLOURS, axes_grid
from difffilter.scoring.truth import measurement_errors, nominal_sigma
from difffilter.sensors.stations import StationSensor
from difffilter.sensors.wrapped import bare

__all__ = ["world_figure"]

#: Trajectories drawn.
SHOWN = 12


def world_figure(filter: Recipe, log: Log, trajectory: int = 0) -> Figure:
    """True paths among the stations, and one trajectory's measurement errors in sigmas.

    Args:
        filter: whose sensors and published sigmas are meant.
        log: with truth.
        trajectory: whose errors are drawn.

    Raises:
        InputError: no truth.
    """
    figure, (left, right) = axes_grid(1, 2)
    _paths(left, filter, log)
    errors = measurement_errors(filter, log)
    one = errors / nominal_sigma(filter, log)
    one = one[:, trajectory] if one.dim() > 2 else one
    time = log.time if log.time.dim() == 1 else log.time[:, trajectory]
    for at, channel in enumerate(filter.channels):
        right.plot(time, one[:, at], ".", markersize=2.5, label=channel)
    right.axhspan(-3.0, 3.0, color=COLOURS["clairvoyant"], alpha=0.15, linewidth=0)
    right.set_yscale("symlog", linthresh=5.0)
    right.set(xlabel="time (s)", ylabel="measured - true (sigma)",
              title="errors of measurements; band: 3 sigma")  # fmt: skip
    if len(filter.channels) <= 8:
        right.legend(fontsize=7, markerscale=3.0, loc="upper left", framealpha=0.6, ncols=2)
    return figure


def _paths(ax: Axes, filter: Recipe, log: Log) -> None:
    assert log.truth is not None
    names = [name for name in filter.states if filter.kinds[name] == "position"][:2]
    names = names or list(filter.states[:1])
    paths = [log.truth[..., log.truth_states.index(name)] for name in names]
    paths = [x.reshape(len(x), -1)[:, :SHOWN] for x in paths]
    if len(names) < 2:
        time = log.time if log.time.dim() == 1 else log.time[:, 0]
        ax.plot(time, paths[0], color=COLOURS["truth"], linewidth=0.6)
        ax.set(xlabel="time (s)", ylabel=f"{names[0]} (m)", title="true paths")
        return
    ax.plot(*paths, color=COLOURS["truth"], linewidth=0.6)
    ax.plot([], [], color=COLOURS["truth"], label="true paths")
    ax.plot(paths[0][0], paths[1][0], ".", color=COLOURS["tuned"], label="starts")
    for label, points in _places(filter, log).items():
        marker = "^" if label == "stations" else "-"
        ax.plot(points[:, 0], points[:, 1], marker, color=COLOURS["published"], label=label)
    ax.set(xlabel=f"{names[0]} (m)", ylabel=f"{names[1]} (m)", title="the world")
    ax.set_aspect("equal", adjustable="datalim")
    ax.legend(fontsize=8, framealpha=0.6)


def _places(filter: Recipe, log: Log) -> dict[str, Tensor]:
    """Stations and the platform's path, (*, 2) each, where there are any."""
    found = {}
    for sensor in map(bare, filter.sensors):
        if isinstance(sensor, StationSensor) and not sensor.platform:
            given = log.inputs.get(f"{sensor.name}.stations")
            fixed = torch.tensor(sensor.stations, dtype=torch.float64)
            points = fixed if given is None else given.reshape(-1, *fixed.shape)[0]
            found["stations"] = points[:, :2]
    platform = [log.inputs[f"platform_{axis}"] for axis in "xy" if f"platform_{axis}" in log.inputs]
    if len(platform) == 2:
        path = torch.stack([x.reshape(len(x), -1)[:, 0] for x in platform], dim=-1)
        found["platform"] = path
    return found
