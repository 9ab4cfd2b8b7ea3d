"""Tables and figures of the manoeuvre experiment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

import difffilter as df
from difffilter.reports.figures.curves import curves_figure
from difffilter.reports.figures.style import COLOURS, axes_grid
from difffilter.reports.report import Report
from difffilter.scoring.metrics import bootstrap_indices, mean_nees, scored_rows
from training.manoeuvre.paper import SAYS

#: Computed independently, 200 runs: mean RMSE in m of x and y in scene 1, in scene 2, and in
#: scene 2 without 10 to 20 s, averaged over x and y.
REFERENCE: dict[str, tuple[float | None, ...]] = {
    "srckf": (17.7, 10.1, 99.3, 94.0, 24.7),
    "lcasrckf": (7.2, 6.4, 73.9, 73.2, 11.9),
    "rmckf": (8.7, 8.3, 74.6, 74.2, 13.1),
    "robust-srckf": (29.7, 15.1, 30.0, 15.1, None),
    "stf-srckf": (6.3, 5.6, 72.9, 72.5, None),
    "fusion": (5.2, 4.6, 5.4, 4.7, 5.1),
}
SHOWN = ("srckf", "lcasrckf", "rmckf", "fusion")


@dataclass(frozen=True)
class Errors:
    """Squared errors (T, B, 2), and the mean NEES per state."""

    squared: Tensor
    nees: float

    @property
    def over_time(self) -> Tensor:
        """(T, 2), RMSE over runs of x and y."""
        return self.squared.mean(1).sqrt()

    @property
    def axes(self) -> list[float]:
        """Mean over time of x and y."""
        found: list[float] = self.over_time.mean(0).tolist()
        return found

    @property
    def mean(self) -> float:
        """Mean over time, averaged over x and y."""
        return sum(self.axes) / 2.0

    @property
    def rms(self) -> float:
        """Root mean squared distance."""
        return float(self.squared.sum(-1).mean().sqrt())


def errors(
    scenario: df.Scenario, log: df.Log, system: str, values: Mapping[str, Tensor] | None = None
) -> Errors:
    """Errors of a system on a log."""
    chosen = scenario.system(system)
    with torch.no_grad():
        track = df.estimate(chosen, df.started(scenario, chosen, log, values), values)
    assert log.truth is not None
    squared = (track.mean[..., :2] - log.truth[..., :2]).square()
    return Errors(squared, float(mean_nees(log, track, scored_rows(log, track))))


def gain(mine: Errors, other: Errors, draws: int = 1000) -> tuple[float, float, float]:
    """Ratio of the mean RMSE, and its paired bootstrap interval over runs."""

    def mean(of: Errors, at: Tensor) -> Tensor:
        return torch.stack([of.squared[:, row].mean(1).sqrt().mean() for row in at])

    at = bootstrap_indices(mine.squared.shape[1], draws, 0)
    ratios = mean(mine, at) / mean(other, at)
    low, high = torch.quantile(ratios, ratios.new_tensor([0.025, 0.975])).tolist()
    return mine.mean / other.mean, low, high


def reference_table(
    report: Report, found: dict[str, dict[str, Errors]], runs: int, judged: bool
) -> None:
    """Both tables of the paper's kind, beside those of a reference computed independently."""
    one, two = found.values()
    rows, apart, cells = [], {}, 0
    for system in one:
        late = two[system].over_time
        without = float(torch.cat([late[:9], late[20:]]).mean())
        got = [*one[system].axes, *two[system].axes, without]
        rows.append([system, "here", *got])
        expected = REFERENCE.get(system)
        if expected is None:
            continue
        rows.append([system, "reference", *expected])
        for place, here, there in zip(HEAD, got, expected, strict=True):
            if there is None:
                continue
            cells += 1
            if abs(here / there - 1.0) > 0.1:
                apart[f"{system}, {place}"] = f"{here:.1f} of {there:.1f}"
    report.heading("Tables: mean RMSE over time")
    report.text(
        f"Mean over 1 to 150 s of the RMSE over {runs} runs, in m. The fusion and the pooled "
        "filters use three sensors, the others one."
    )
    report.table("reference", ["system", "from", *HEAD], rows, SAYS["reference"])
    if judged:
        report.claim(
            f"reference values within 10 % ({cells - len(apart)} of {cells})", not apart, apart
        )


HEAD = ("scene 1 x", "scene 1 y", "scene 2 x", "scene 2 y", "scene 2 without 10 to 20 s")


def track_panel(report: Report, scenario: df.Scenario, log: df.Log) -> None:
    """Figure 2: the true track and one run's measurements."""
    figure, (ax,) = axes_grid(1, 1, width=6.0, height=5.0)
    assert log.truth is not None
    at = [scenario.channels.index(name) for name in ("x_r", "y_r")]
    x, y = (log.z[:, 0, i] / 1e3 for i in at)
    good = (log.z[:, 0, at] != 0.0).all(-1)
    ax.plot(x[good], y[good], ".", ms=3, color=COLOURS["other"], label="measured, one run")
    ax.plot(*(log.truth[:, 0, :2] / 1e3).T, color=COLOURS["truth"], lw=1.4, label="truth")
    for k in (30, 60, 80, 90, 120):
        ax.annotate(f"{k} s", (log.truth[k - 1, 0, :2] / 1e3).tolist(), fontsize=8)
    ax.set(xlabel="x (km)", ylabel="y (km)")
    ax.legend(fontsize=8)
    caption = (
        "Figure 2: one trajectory; turns at 30 to 60 s and 90 to 120 s, a jump at 80 s; "
        "measurements of the precise sensor, no filter"
    )
    report.figure(figure, "figure-2-track", caption, SAYS["figure 2"])


def figures(report: Report, found: dict[str, dict[str, Errors]]) -> None:
    """Figures 3 to 8: RMSE over time."""
    one, two = found.values()
    seconds = list(range(1, 151))
    number = 3
    plans = (
        (one, "scene 1", SHOWN, False),
        (two, "scene 2", SHOWN, True),
        (two, "scene 2, robust filters", ("robust-srckf", "fusion", "pooled-robust"), False),
    )
    for results, title, names, log in plans:
        for i, axis in enumerate("xy"):
            shown = {name: results[name].over_time[:, i].tolist() for name in names}
            panel = f"{title}, RMSE of {axis}"
            own = "; pooled-robust is this project's, hand-picked" * ("pooled-robust" in names)
            runs = results["fusion"].squared.shape[1]
            caption = f"Figure {number}: {panel}, published values{own}; {runs} trajectories"
            figure = curves_figure(
                {panel: (seconds, shown)}, "time (s)", f"RMSE of {axis} (m)", log=log,
                emphasised=("fusion",), markers=False,
            )  # fmt: skip
            report.figure(figure, f"figure-{number}", caption, SAYS[f"figure {number}"])
            number += 1
