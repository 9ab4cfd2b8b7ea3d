"""Start from the first measurements: recorded ranges, simulated range differences, edge cases."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import STATIONS, assert_close, tensor
from oracles import airport

from difffilter.baselines import TaylorLeastSquares
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, stack_logs
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.batch import run
from difffilter.sensors.builtin import TDOA, Position, Range
from difffilter.sensors.sensor import FunctionSensor
from difffilter.start.measurements import from_measurements

RECORDED = Path(__file__).parents[3] / "shared" / "data" / "uwb_ranges"
recorded = pytest.mark.skipif(
    not RECORDED.is_dir(), reason="no recorded ranges beside the checkout"
)
CHANNELS = ("range_a3", "range_a5", "range_a9", "range_a12")
NAN = float("nan")


def recorded_runs() -> list[Log]:
    """The four recorded runs with their anchors."""
    anchors: dict[str, list[list[float]]] = {}
    with open(RECORDED / "anchors.csv") as file:
        for row in csv.DictReader(file):
            anchors.setdefault(row["run"], []).append([float(row[key]) for key in "xyz"])
    logs = []
    for name, stations in anchors.items():
        with open(RECORDED / f"{name}.csv") as file:
            rows = list(csv.DictReader(file))
        data = {key: tensor([float(row[key] or NAN) for row in rows]) for key in rows[0]}
        z, truth = (
            torch.stack([data[key] for key in keys], -1)
            for keys in (CHANNELS, ("truth_x", "truth_y"))
        )
        known = {"range.stations": tensor(stations).expand(len(rows), 4, 3)}
        logs.append(Log(CHANNELS, data["time"], z, truth, ("x", "y"), known, names=(name,)))
    return logs


def range_filter(stations: object = ((0, 0, 2), (2, 1, 2), (3, 0, 1), (1, -1, 1))) -> Filter:
    sensor = Range(stations=stations, height=1.0, sigma=0.1, channels=CHANNELS)  # type: ignore[arg-type]
    return Filter(ConstantVelocity(2), (sensor,), start_sigma=1.0)


def repeated(logs: list[Log]) -> Log:
    """Logs of one run each as one batch."""
    return stack_logs(logs)


def errors(log: Log, **options: float) -> torch.Tensor:
    start = from_measurements(range_filter(), log, **options)
    assert log.truth is not None
    return (start.mean[..., :2] - log.truth[0]).norm(dim=-1)


@recorded
def test_recorded_runs_start_within_20_cm() -> None:
    log = stack_logs(recorded_runs())
    assert (errors(log) < 0.2).all()
    start = from_measurements(range_filter(), log)
    assert start.covariance is None
    assert (start.mean[:, 2:] == 0).all()
    track = run(range_filter(), log, start=start)
    assert torch.isfinite(track.mean).all()


@recorded
def test_one_wild_value_among_the_first_five_rows() -> None:
    variants = []
    for log in recorded_runs():
        for row in range(5):
            for channel in range(4):
                for wild in (-20.0, -10.0, -3.0, 3.0, 10.0, 20.0):
                    z = log.rows(0, 40).z.clone()
                    z[row, channel] += wild
                    variants.append(replace(log.rows(0, 40), z=z))
    assert (errors(repeated(variants)) < 0.2).all()


@recorded
def test_starts_in_the_middle_of_recorded_runs() -> None:
    """Poor geometry: a few of a hundred starts may be mirrored or far off, most not."""
    parts = []
    for log in recorded_runs():
        for first in np.linspace(30, log.steps - 300, 25).astype(int):
            part = log.rows(first, first + 280)
            keep = int(part.measured.nonzero()[0, 0])  # compare where the ranges begin
            parts.append(part.rows(keep, part.steps))
    error = errors(repeated(parts))
    assert error.median() < 0.7
    assert (error > 3.0).sum() <= 10


@pytest.mark.parametrize(("p", "usual", "worst"), [(0.1, 2.0, 6.0), (0.3, 3.5, 20.0)])
def test_range_differences_with_reflections(
    rng: np.random.Generator, p: float, usual: float, worst: float
) -> None:
    data = airport.simulate(rng, 200, 10, 10.0, 100.0, p)
    z = tensor(data["measurements"]).transpose(0, 1)
    sensor = TDOA(stations=STATIONS, sigma=airport.metres(10.0))
    log = Log(sensor.channels, torch.arange(11).double() * 0.1, z)
    start = from_measurements(Filter(ConstantVelocity(2), (sensor,)), log)
    # The position is that of the mean of the ten rows, taken as constant; of the first row
    # where more had to tell, with a velocity.
    truth = tensor(data["truth"])[..., :2]
    waited = (start.mean[:, 2:] != 0.0).any(-1, keepdim=True)
    error = (start.mean[:, :2] - torch.where(waited, truth[:, 0], truth[:, :10].mean(1))).norm(
        dim=-1
    )
    assert error.square().mean().sqrt() < usual
    assert error.max() < worst


def ring_log(rng: np.random.Generator, runs: int, rows: int = 15) -> tuple[Log, torch.Tensor]:
    """Standing targets about the stations of :func:`range_filter`; true positions."""
    truth = tensor(rng.uniform(-20.0, 20.0, (runs, 2)))
    sensor = range_filter().sensors[0]
    h = sensor.predict(truth, {}, range_filter().prepare())
    z = h + 0.01 * tensor(rng.standard_normal((rows, runs, 4)))
    return Log(CHANNELS, torch.arange(rows).double() * 0.1, z), truth


def test_batch_is_single_and_padding_is_nothing(rng: np.random.Generator) -> None:
    log, truth = ring_log(rng, 130)
    log.z[:3, 5] = NAN
    log.z[0, 7, 1:] = NAN
    batch = from_measurements(range_filter(), log)
    assert (batch.mean[:, :2] - truth).norm(dim=-1).max() < 0.5
    singles = [replace(log, z=log.z[:, i]) for i in (0, 5, 7, 129)]
    for i, single in zip((0, 5, 7, 129), singles, strict=True):
        assert_close(from_measurements(range_filter(), single).mean, batch.mean[i], 1e-9)
    shorter = [single.rows(0, 13 + i % 2) for i, single in enumerate(singles)]
    padded = from_measurements(range_filter(), stack_logs(shorter))
    assert_close(padded.mean, batch.mean[[0, 5, 7, 129]], 1e-9)


def test_rows_go_on_until_a_position_is_determined(rng: np.random.Generator) -> None:
    """One channel for 4 s, then the next, then a third: rows beyond the span are taken."""
    log, truth = ring_log(rng, 3, 150)
    z = torch.full_like(log.z, NAN)
    for i in range(3):
        z[40 * i : 40 * i + 40, :, i] = log.z[40 * i : 40 * i + 40, :, i]
    start = from_measurements(range_filter(), replace(log, z=z))
    assert (start.mean[:, :2] - truth).norm(dim=-1).max() < 1.0


@pytest.mark.parametrize("names", [(), ("first", "second", "third")])
def test_undetermined_trajectory_is_named(rng: np.random.Generator, names: tuple[str, ...]) -> None:
    log, _ = ring_log(rng, 3)
    for present in (0, 1):
        z = log.z.clone()
        z[:, 2, present:] = NAN
        with pytest.raises(
            InputError, match=rf"trajectory {names[2] if names else 2}: .* position"
        ):
            from_measurements(range_filter(), replace(log, z=z, names=names))


def test_position_sensor_starts_at_the_robust_centre(rng: np.random.Generator) -> None:
    sensor = Position(sigma=1.0)
    z = tensor([100.0, -50.0]) + tensor(rng.standard_normal((20, 4, 2)))
    z[2, :, 0] += 1e4
    z[0, 1, 1] = NAN
    log = Log(sensor.channels, torch.arange(20).double() * 0.1, z)
    recipe = Filter(ConstantVelocity(2), (sensor,))
    start = from_measurements(recipe, log)
    assert (start.mean[:, :2] - tensor([100.0, -50.0])).norm(dim=-1).max() < 1.5
    one = from_measurements(recipe, log.rows(0, 1).select([0]), rows=1)
    assert_close(one.mean[0, :2], z[0, 0], 1e-9)


def test_users_sensor_and_three_axes(rng: np.random.Generator) -> None:
    """Range and bearing from the origin; ranges in space; both from afar."""
    truth = tensor([-900.0, 350.0])

    def radar(x: torch.Tensor, inputs: object, values: object) -> torch.Tensor:
        return torch.stack([x[..., :2].norm(dim=-1), torch.atan2(x[..., 1], x[..., 0])], -1)

    sensor = FunctionSensor(("range", "bearing"), radar, (1.0, 0.01))
    z = radar(truth, {}, {}).expand(5, 2)
    log = Log(sensor.channels, torch.arange(5).double(), z)
    start = from_measurements(Filter(ConstantVelocity(2), (sensor,)), log)
    assert_close(start.mean, torch.cat([truth, tensor([0.0, 0.0])]), 1e-6)

    stations = rng.uniform(-5.0, 5.0, (5, 3))
    positions = tensor(rng.uniform(-30.0, 30.0, (20, 3)))
    ranges = Range(stations=stations.tolist(), axes=3, sigma=0.1)
    recipe = Filter(ConstantVelocity(3), (ranges,))
    z = ranges.predict(positions, {}, recipe.prepare()).expand(3, 20, 5)
    log = Log(ranges.channels, torch.arange(3).double(), z)
    assert_close(from_measurements(recipe, log).mean[:, :3], positions, 1e-6)


def test_covariance_on_request(rng: np.random.Generator) -> None:
    log, _ = ring_log(rng, 4)
    start = from_measurements(range_filter(), log, velocity_sigma=2.0)
    covariance = start.covariance
    assert covariance is not None
    assert covariance.shape == (4, 4, 4)
    assert (covariance[:, 2, 2] == 4.0).all()
    # Half the ten rows of 0.1 s at 2 m/s: 0.9 m, beside the fit's own.
    assert (covariance[:, :2, :2].diagonal(dim1=-2, dim2=-1) > 0.9**2).all()
    assert torch.isfinite(run(range_filter(), log, start=start).mean).all()


def test_float32_inputs_and_estimators(rng: np.random.Generator) -> None:
    log, truth = ring_log(rng, 6)
    start = from_measurements(range_filter(), log.to(torch.float32))
    assert start.mean.dtype == torch.float32
    assert (start.mean[:, :2] - truth).norm(dim=-1).max() < 0.5
    snapshot = TaylorLeastSquares(range_filter().sensors)
    assert from_measurements(snapshot, log).mean.shape == (6, 2)
    assert (snapshot.estimate(log).mean - truth).norm(dim=-1).max() < 0.5
    moved = tensor(np.array(range_filter().sensors[0].stations)) + tensor([50.0, 0.0, 0.0])
    known = {"range.stations": moved.expand(15, 6, 4, 3)}
    shifted = from_measurements(range_filter(), replace(log, inputs=known))
    assert (shifted.mean[:, :2] - truth - tensor([50.0, 0.0])).norm(dim=-1).max() < 0.5


def test_wrong_arguments(rng: np.random.Generator) -> None:
    log, _ = ring_log(rng, 2)
    with pytest.raises(InputError, match="rows"):
        from_measurements(range_filter(), log, rows=0)
    with pytest.raises(InputError, match="found channels"):
        from_measurements(range_filter(), replace(log, channels=tuple("abcd")))
