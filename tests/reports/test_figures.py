"""Figures: one trajectory drawn from batches and single logs, with and without truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import matplotlib
import numpy as np
import pytest
import torch
from helpers import array
from matplotlib.figure import Figure
from run_cases import FILTERS, airport_log

from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.mixture import Mixture
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.motions.blocks import ConstantVelocity
from difffilter.reports.figures.modes import modes_figure
from difffilter.reports.figures.style import axes_grid, save_figure
from difffilter.reports.figures.tracks import track_figure
from difffilter.running.batch import run
from difffilter.sensors.builtin import Position

LOG = airport_log(25, 3, seed=8)
TRACK = run(FILTERS["m-ekf"], LOG)


def single() -> tuple[Log, Track]:
    assert LOG.truth is not None
    assert LOG.start is not None
    start = Start(LOG.start.mean[1], None, 0.0)
    log = replace(LOG, z=LOG.z[:, 1], truth=LOG.truth[:, 1], start=start)
    return log, run(FILTERS["m-ekf"], log)


def drawn(figure: Figure, label: str) -> np.ndarray:
    """Points of the first line with that label, (rows, 2)."""
    lines = [line for ax in figure.axes for line in ax.get_lines() if line.get_label() == label]
    return np.asarray(lines[0].get_xydata())


def test_the_track_of_one_trajectory_of_a_batch_is_drawn() -> None:
    figure = track_figure(LOG, TRACK, 2, "title")
    assert LOG.truth is not None
    assert np.array_equal(drawn(figure, "estimate"), array(TRACK.mean[:, 2, :2]))
    assert np.array_equal(drawn(figure, "truth"), array(LOG.truth[:, 2, :2]))
    error = drawn(figure, "error")
    assert np.array_equal(error[:, 0], array(LOG.time))
    assert np.array_equal(error[:, 1], array(TRACK.mean[:, 2, 0] - LOG.truth[:, 2, 0]))
    assert figure.get_suptitle() == "title"


def test_a_single_log_is_drawn_like_its_place_in_the_batch() -> None:
    found, expected = track_figure(*single()), track_figure(LOG, TRACK, 1)
    np.testing.assert_allclose(drawn(found, "estimate"), drawn(expected, "estimate"), rtol=1e-12)
    np.testing.assert_allclose(drawn(found, "error"), drawn(expected, "error"), atol=1e-9)


def test_without_truth_the_estimate_alone_is_drawn() -> None:
    log = replace(LOG, truth=None, truth_states=())
    figure = track_figure(log, TRACK, 0)
    assert np.array_equal(drawn(figure, "estimate"), array(TRACK.mean[:, 0, :2]))
    labels = {line.get_label() for ax in figure.axes for line in ax.get_lines()}
    assert "truth" not in labels
    assert "error" not in labels


def test_times_of_each_trajectory_and_truth_with_gaps_are_drawn() -> None:
    assert LOG.truth is not None
    truth = LOG.truth.clone()
    truth[3:9, 1] = torch.nan
    time = LOG.time.unsqueeze(-1) * torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    log = replace(LOG, time=time, truth=truth)
    figure = track_figure(log, replace(TRACK, time=time), 1)
    assert np.array_equal(drawn(figure, "error")[:, 0], array(time[:, 1]))
    nothing = replace(log, truth=torch.full_like(truth, torch.nan))
    assert np.isnan(drawn(track_figure(nothing, TRACK, 1), "error")[:, 1]).all()


def test_weights_are_drawn_and_missing_channels_left_white() -> None:
    figure = track_figure(LOG, TRACK, 1)
    record = TRACK.record
    assert record is not None
    mesh = next(
        ax
        for ax in figure.axes
        if ax.collections and ax.get_yticklabels()[0].get_text() == "tdoa_2"
    )
    shown = np.ma.asarray(mesh.collections[0].get_array()).reshape(7, 25)
    expected = np.where(array(record.present[:, 1]), array(record.weight[:, 1]), np.nan).T
    np.testing.assert_array_equal(np.ma.filled(shown, np.nan), expected)


def test_estimators_without_weights_and_worlds_of_one_axis_are_drawn(tmp_path: Path) -> None:
    save_figure(track_figure(LOG, replace(TRACK, record=None), 0), tmp_path / "a")
    filter = Filter(ConstantVelocity(1), (Position(axes=1),), start_sigma=1.0)
    z = torch.arange(8.0).double().unsqueeze(-1)
    log = Log(filter.channels, torch.arange(8.0).double(), z, z, ("x",))
    track = run(filter, log, start=Start(torch.zeros(2).double()))
    save_figure(track_figure(log, track), tmp_path / "b")
    assert len(list(tmp_path.iterdir())) == 4


@pytest.mark.parametrize("suffix", ["", ".png", ".pdf"])
def test_png_and_svg_are_written_beside_each_other(tmp_path: Path, suffix: str) -> None:
    save_figure(track_figure(LOG, TRACK, 0), tmp_path / "new" / f"track{suffix}")
    names = sorted(path.name for path in (tmp_path / "new").iterdir())
    assert names == ["track.png", "track.svg"]
    assert (tmp_path / "new" / "track.png").read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
    assert "<svg" in (tmp_path / "new" / "track.svg").read_text()


def test_the_global_figure_and_settings_are_left_alone(tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    save_figure(track_figure(LOG, TRACK, 0), tmp_path / "x")
    assert dict(matplotlib.rcParams) == before
    import matplotlib.pyplot as plt

    assert plt.get_fignums() == []


def test_a_grid_has_its_axes_row_by_row() -> None:
    figure, axes = axes_grid(2, 3)
    assert len(axes) == len(figure.axes) == 6
    assert axes[1].get_subplotspec().colspan.start == 1  # type: ignore[union-attr]
    assert axes[3].get_subplotspec().rowspan.start == 1  # type: ignore[union-attr]


def test_a_mixtures_probabilities_are_stacked_over_time() -> None:
    filter = FILTERS["m-ekf"]
    track = run(Mixture({"one": filter, "other": filter}, share=(0.7, 0.3)), LOG)
    figure = modes_figure(track, 2, "modes")
    one, other = figure.axes[0].collections
    assert [one.get_label(), other.get_label()] == ["one", "other"]
    found = one.get_paths()[0].vertices
    assert track.record is not None
    assert found[:, 1].max() == pytest.approx(float(track.record.modes[:, 2, 0].max()))
    assert other.get_paths()[0].vertices[:, 1].max() == pytest.approx(1.0)
    assert len(track_figure(LOG, track, 0).axes) == len(track_figure(LOG, TRACK, 0).axes) + 1
    with pytest.raises(InputError, match="a track of no mixture"):
        modes_figure(TRACK)
