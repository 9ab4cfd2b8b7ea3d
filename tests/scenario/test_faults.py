"""Faults: when they strike, what they add, and what a clairvoyant is told of them."""

from __future__ import annotations

import math
import re
from typing import Any

import pytest
import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.scenario.distribution import Distribution, read_distribution
from difffilter.scenario.faults import Fault, read_fault
from difffilter.scenario.sensing import SensorSpec, read_sensor
from difffilter.scenario.table import Table
from difffilter.seeds import stream

CHANNELS = ("range_1", "range_2", "height")
SIGMA = 2.5
STEPS, RUNS = 60, 400
DISTRIBUTIONS: dict[str, dict[str, Any]] = {
    "constant": {"distribution": "constant", "value": 3.0},
    "uniform": {"distribution": "uniform", "low": 1.0, "high": 4.0},
    "normal": {"distribution": "normal", "mean": 2.0, "sigma": 1.5},
    "two-sided constant": {"distribution": "constant", "value": 3.0, "two_sided": True},
    "two-sided uniform": {"distribution": "uniform", "low": 1.0, "high": 4.0, "two_sided": True},
    "two-sided normal": {"distribution": "normal", "mean": 2.0, "sigma": 1.5, "two_sided": True},
    "scaled": {"distribution": "uniform", "low": 0.5, "high": 1.0, "scale": 50.0, "unit": "cm"},
}


def sensor(name: str, **keys: Any) -> SensorSpec:
    return read_sensor(name, Table(keys, "test", f"sensors.{name}"), 2)


RANGES = sensor("range", kind="range", stations=[[0.0, 0.0], [9.0, 0.0]], noise={"sigma": SIGMA})
HEIGHT = sensor("more", kind="range", stations=[[0.0, 5.0]], channels=["height"])
BEARING = sensor("bearing", kind="bearing", noise={"sigma": 0.5, "unit": "deg"})


def read(table: dict[str, Any], *sensors: SensorSpec) -> Fault:
    return read_fault("f", Table(table, "test", "faults.f"), sensors)


def fault(**keys: Any) -> Fault:
    size = {"distribution": "constant", "value": 5.0}
    needed = keys.get("kind", "offset") == "offset" and "distribution" not in keys
    return read({"kind": "offset"} | (size if needed else {}) | keys, RANGES, HEIGHT)


def strike(made: Fault, seed: int = 1, z: float = 100.0) -> tuple[Tensor, Tensor, Tensor]:
    start = torch.full((STEPS, RUNS, 3), z, dtype=torch.float64)
    return made.strike(start, CHANNELS, stream(seed, "fault"))


def within(share: Tensor | float, expected: float, count: int, sigmas: float = 5.0) -> bool:
    """Whether a share of ``count`` independent draws is what chance allows."""
    spread = (expected * (1.0 - expected) / count) ** 0.5
    return abs(float(share) - expected) <= sigmas * spread


@pytest.mark.parametrize("probability", [0.0, 0.03, 0.5, 1.0])
def test_channels_are_struck_independently_with_the_probability(probability: float) -> None:
    z, _, _ = strike(fault(probability=probability))
    struck = (z != 100.0).double()
    assert within(struck.mean(), probability, struck.numel())
    pairs = (struck[..., 0] * struck[..., 1]).mean()
    assert within(pairs, probability**2, STEPS * RUNS)


def test_a_joint_fault_strikes_all_its_channels_with_one_offset() -> None:
    made = fault(joint=True, probability=0.2, channels=["range_*"], **DISTRIBUTIONS["uniform"])
    z, _, _ = strike(made)
    offset = z - 100.0
    assert torch.equal(offset[..., 0], offset[..., 1])
    assert within((offset[..., 0] != 0).double().mean(), 0.2, STEPS * RUNS)
    assert not offset[..., 2].any()


def test_only_the_named_channels_are_struck() -> None:
    z, mean, variance = strike(fault(channels=["*_2", "hei?ht"]))
    assert (z[..., 0] == 100.0).all()
    assert (z[..., 1:] == 105.0).all()
    assert mean[0, 0].tolist() == [0.0, 5.0, 5.0]
    assert not variance.any()


@pytest.mark.parametrize("duration", [2, 7, 200])
def test_a_burst_lasts_its_duration(duration: int) -> None:
    p = 0.02
    single, _, _ = strike(fault(probability=p))
    burst, _, _ = strike(fault(probability=p, duration=duration))
    begins, struck = single != 100.0, burst != 100.0
    expected = torch.zeros_like(begins)
    for k in range(STEPS):
        expected[k] = begins[max(0, k - duration + 1) : k + 1].any(0)
    assert torch.equal(struck, expected)
    last = min(duration, STEPS)
    assert within(struck[-1].double().mean(), 1.0 - (1.0 - p) ** last, RUNS * 3)


def test_windows_hold_the_steps_in_which_faults_begin() -> None:
    z, _, _ = strike(fault(windows=[[1, 2], [10, 12], [60, 99]]))
    rows = (z[:, 0, 0] != 100.0).nonzero().flatten().tolist()
    assert rows == [0, 1, 9, 10, 11, 59]
    z, _, _ = strike(fault(windows=[[10, 12]], duration=3))
    assert (z[:, 0, 0] != 100.0).nonzero().flatten().tolist() == [9, 10, 11, 12, 13]


def test_a_zeroed_channel_reads_zero_and_is_useless() -> None:
    z, mean, variance = strike(fault(kind="zero", probability=0.3))
    struck = z == 0.0
    assert within(struck.double().mean(), 0.3, struck.numel())
    assert (z[~struck] == 100.0).all()
    assert torch.equal(variance.isinf(), struck)
    assert not mean.any()


def test_a_dropped_channel_is_missing_and_nothing_need_be_told() -> None:
    z, mean, variance = strike(fault(kind="dropout", probability=0.3, joint=True))
    gone = z.isnan()
    assert within(gone[..., 0].double().mean(), 0.3, STEPS * RUNS)
    assert torch.equal(gone[..., 0], gone[..., 2])
    assert (z[~gone] == 100.0).all()
    assert not mean.any()
    assert not variance.any()


@pytest.mark.parametrize("name", DISTRIBUTIONS)
def test_the_clairvoyant_is_told_the_samples_mean_and_variance(name: str) -> None:
    z, mean, variance = strike(fault(probability=0.4, **DISTRIBUTIONS[name]), z=0.0)
    struck = z != 0.0
    added = z[struck]
    assert len(added) > 20000
    assert mean[struck].unique().numel() == 1
    told, spread = float(mean[struck][0]), float(variance[struck][0])
    assert not mean[~struck].any()
    assert not variance[~struck].any()
    assert abs(float(added.mean()) - told) <= 5 * (spread / len(added)) ** 0.5 + 1e-12
    squared = (added - told).square()
    error = abs(float(squared.mean()) - spread)
    assert error <= 5 * float(squared.std()) / len(added) ** 0.5 + 1e-12


def test_offsets_are_drawn_anew_in_every_row_and_channel() -> None:
    z, _, _ = strike(fault(**DISTRIBUTIONS["uniform"]), z=0.0)
    assert z.unique().numel() == z.numel()
    assert float(z.min()) >= 1.0
    assert float(z.max()) <= 4.0


@pytest.mark.parametrize("name", ["uniform", "normal", "two-sided normal"])
def test_a_distribution_with_one_number_per_axis(name: str) -> None:
    table = dict(DISTRIBUTIONS[name])
    key = "low" if "low" in table else "sigma"
    table[key] = [0.5, table[key]]
    drawn: Distribution = read_distribution(Table(table, "test"), 2)
    sample = drawn.sample((40000, 2), stream(3))
    spread = drawn.variance.sqrt()
    assert bool(((sample.mean(0) - drawn.mean).abs() <= 5 * spread / 200.0).all())
    assert bool((sample.std(0) / spread - 1).abs().le(0.03).all())
    assert float(spread[0]) != float(spread[1])


def test_two_faults_add_up_in_what_they_do_and_tell() -> None:
    first, second = (
        fault(windows=[[5, 9]]),
        fault(windows=[[8, 12]], distribution="constant", value=-2.0),
    )
    z, mean_1, _ = strike(first)
    z, mean_2, _ = second.strike(z, CHANNELS, stream(2))
    assert torch.equal(z - 100.0, mean_1 + mean_2)
    assert (z[:, 0, 0] - 100.0).unique().tolist() == [-2.0, 0.0, 3.0, 5.0]


OFFSET = {"kind": "offset", "distribution": "constant", "value": 3.0}


@pytest.mark.parametrize(
    ("unit", "factor"), [("rad", 1.0), ("mrad", 1e-3), ("deg", math.pi / 180), ("sigma", None)]
)
def test_an_offset_of_a_bearing_is_an_angle_or_so_many_sigmas(
    unit: str, factor: float | None
) -> None:
    made = read(OFFSET | {"unit": unit}, BEARING)
    z, mean, variance = made.strike(torch.zeros(4, 2, 1).double(), ("bearing",), stream(1))
    expected = 3.0 * (math.radians(0.5) if factor is None else factor)
    assert float((z - expected).abs().max()) < 1e-15
    assert torch.equal(mean, z)
    assert not variance.any()


def test_without_a_unit_an_offset_is_in_metres_or_radians() -> None:
    assert read(OFFSET, BEARING).scale == read(OFFSET, RANGES).scale == 1.0


def test_sigmas_are_those_of_the_channels_that_are_struck() -> None:
    made = read(OFFSET | {"unit": "sigma", "scale": 2.0, "channels": ["range_*"]}, RANGES, BEARING)
    assert made.scale == 2.0 * SIGMA
    z, mean, _ = made.strike(torch.zeros(2, 1, 3).double(), (*CHANNELS[:2], "bearing"), stream(1))
    assert z[0, 0].tolist() == mean[0, 0].tolist() == [6.0 * SIGMA, 6.0 * SIGMA, 0.0]
    drawn = read(
        {"kind": "offset", "distribution": "uniform", "low": 2.0, "high": 10.0, "unit": "sigma"},
        BEARING,
    )
    _, mean, variance = drawn.strike(torch.zeros(1, 1, 1).double(), ("bearing",), stream(1))
    assert float(mean) == pytest.approx(6.0 * math.radians(0.5))
    assert float(variance) == pytest.approx(64.0 / 12.0 * math.radians(0.5) ** 2)


def test_sensors_of_the_same_sigma_share_a_fault_in_sigmas() -> None:
    twin = sensor("twin", kind="position", noise={"sigma": 250.0, "unit": "cm"})
    assert read(OFFSET | {"unit": "sigma"}, RANGES, twin).scale == SIGMA


#: What is added to the offset, the sensors, and what the message says.
REFUSED = {
    "metres on a bearing": ({"unit": "m"}, (BEARING,), "unit: found 'm', expected one of rad, mr"),
    "degrees on a range": ({"unit": "deg"}, (RANGES,), "unit: found 'deg', expected one of m, km"),
    "lengths and angles": ({}, (RANGES, BEARING), "channels: found nothing, expected channels of"),
    "both by name": (
        {"channels": ["range_1", "bearing"]}, (RANGES, BEARING),
        "channels: found ['range_1', 'bearing'], expected channels of lengths or of angles",
    ),
    "sigmas that differ": (
        {"unit": "sigma"}, (RANGES, HEIGHT), "unit: found 'sigma', expected one of m, km",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", REFUSED)
def test_a_unit_that_the_struck_channels_do_not_have_is_refused(name: str) -> None:
    keys, sensors, message = REFUSED[name]
    with pytest.raises(InputError, match=re.escape(f"test: faults.f.{message}")):
        read(OFFSET | keys, *sensors)


@pytest.mark.parametrize("kind", ["zero", "dropout"])
def test_faults_without_a_size_may_strike_lengths_and_angles(kind: str) -> None:
    made = read({"kind": kind}, RANGES, BEARING)
    z, _, _ = made.strike(torch.ones(1, 1, 3).double(), (*CHANNELS[:2], "bearing"), stream(1))
    assert not z.nan_to_num().any()
