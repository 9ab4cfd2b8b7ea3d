"""Recovery of a group of channels by itself, and its end where sensors contradict each other."""

from __future__ import annotations

import pytest
import torch
from helpers import array, assert_close, number, tensor
from recovery_cases import RECOVERIES

from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.motions.blocks import ConstantVelocity
from difffilter.robust.gate import Gate
from difffilter.robust.recovery import STREAK
from difffilter.running.batch import run
from difffilter.running.tracker import Tracker
from difffilter.sensors.builtin import Position
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.stations import Range

NAMES = list(RECOVERIES)


def gated(name: str, *sensors: Sensor, **options: object) -> Filter:
    chosen: dict[str, object] = {"gate": Gate("reject"), "recovery": RECOVERIES[name]} | options
    return Filter(ConstantVelocity(), sensors, linearise="taylor", **chosen)  # type: ignore[arg-type]


def noise(rows: int, channels: int) -> torch.Tensor:
    seed = torch.Generator().manual_seed(5)
    return torch.randn(rows, channels, generator=seed, dtype=torch.float64)


def tracked(filter: Filter, z: torch.Tensor, dt: float, covariance: list[float]) -> Track:
    time = dt * torch.arange(len(z)).double()
    start = Start(torch.zeros(4).double(), torch.diag(tensor(covariance)))
    return run(filter, Log(filter.channels, time, z), start=start)


@pytest.mark.parametrize("name", NAMES)
def test_a_jump_on_one_axis_is_recovered_though_the_other_is_accepted(name: str) -> None:
    filter = gated(name, Position(sigma=1.0))
    z = noise(240, 2)
    quiet = tracked(filter, z, 0.1, [1.0] * 4)
    z[50:, 0] += 200.0
    track = tracked(filter, z, 0.1, [1.0] * 4)
    assert float((track.mean[-40:, 0] - 200.0).abs().max()) < 3.0
    assert float((track.mean[:, 1] - quiet.mean[:, 1]).abs().max()) < 2.0


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("sigma", [3.0, 30.0])
def test_a_position_is_believed_in_the_end_beside_a_range_that_agrees(
    name: str, sigma: float
) -> None:
    """The filter is off across the line of sight, of which the range tells nothing."""
    beacon = Range(stations=[(0.0, -1000.0)], sigma=sigma)
    filter = gated(name, Position(sigma=10.0), beacon)
    truth = tensor([120.0, 0.0])
    distance = (truth - tensor([0.0, -1000.0])).norm()
    z = noise(120, 3) * tensor([10.0, 10.0, sigma]) + tensor([120.0, 0.0, float(distance)])
    track = tracked(filter, z, 1.0, [4.0, 4.0, 0.01, 0.01])
    off = (track.mean[:, :2] - truth).norm(dim=-1)
    assert float(off[:4].min()) > 100.0
    assert float(off[60:].max()) < 25.0


@pytest.mark.parametrize("engine", ["torch", "fused"])
@pytest.mark.parametrize("name", NAMES)
def test_sensors_that_contradict_each_other_do_not_grow_the_covariance(
    name: str, engine: str
) -> None:
    filter = gated(name, Position(name="a", sigma=1.0), Position(name="b", sigma=1.0), scope="all")
    bare = Filter(filter.motion, filter.sensors, scope="all", gate=Gate("reject"))
    trackers = [Tracker(x, [0.0] * 4, torch.eye(4).double(), engine=engine) for x in (filter, bare)]
    for _ in range(600):
        for tracker in trackers:
            record = tracker.step([0.0, 0.0, 30.0, 0.0], 0.1)
            assert not record.weight.any()
    ours, plain = (x.belief.covariance for x in trackers)
    assert_close(ours, plain, 1e-12)
    assert number(trackers[0].belief.memory[STREAK][0]) == 600.0
    accepted = [
        bool(trackers[0].step([500.0, 0.0, 500.0, 0.0], 0.1).weight.all()) for _ in range(20)
    ]
    assert accepted[-1]
    assert abs(array(trackers[0].belief.mean)[0] - 500.0) < 5.0


def test_the_count_stays_finite_in_float32_too() -> None:
    filter = gated(
        "widen", Position(name="a", sigma=1.0), Position(name="b", sigma=1.0), scope="all"
    )
    values = {name: x.float() for name, x in filter.published().items()}
    tracker = Tracker(filter, torch.zeros(4), torch.eye(4), values, engine="torch")
    for _ in range(150):
        tracker.step([0.0, 0.0, 30.0, 0.0], 0.1)
    tracker.step([1.0, 0.0, 1.0, 0.0], 0.1)
    assert bool(torch.isfinite(tracker.belief.deviations).all())
    assert number(tracker.belief.memory[STREAK][0].double()) == 0.0
