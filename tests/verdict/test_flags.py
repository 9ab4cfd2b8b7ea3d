"""Each red flag from what is known alone, and directions of P against NumPy."""

from __future__ import annotations

import math

import numpy as np
import torch
from helpers import tensor

from difffilter import Log
from difffilter.logs.track import Track
from difffilter.parameters.constraints import Bounded, Interval
from difffilter.parameters.parameters import Parameter
from difffilter.scoring.directions import mean_directions
from difffilter.verdict import flags as red


def test_nees_by_direction_is_numpys() -> None:
    rng = np.random.default_rng(3)
    count = 40
    factor = rng.normal(size=(count, 1, 4, 4))
    truth, mean = rng.normal(size=(2, count, 1, 4))
    time = torch.arange(float(count), dtype=torch.float64)
    states = ("x", "y", "vx", "vy")
    log = Log(("c",), time, torch.zeros(count, 1, 1, dtype=torch.float64), tensor(truth), states)
    track = Track(states, ("c",), time, tensor(mean), tensor(factor), None)
    found = mean_directions(log, track, torch.ones(count, 1, dtype=torch.bool))
    for block, at in (("position", slice(0, 2)), ("velocity", slice(2, 4))):
        expected = np.zeros(2)
        for k in range(count):
            part = factor[k, 0, at]
            values, vectors = np.linalg.eigh(part @ part.T)
            along = vectors.T @ (mean - truth)[k, 0, at]
            expected += along**2 / values / count
        np.testing.assert_allclose(found[f"{block} along the short axis"], expected[0], rtol=1e-9)
        np.testing.assert_allclose(found[f"{block} along the long axis"], expected[1], rtol=1e-9)


def test_a_mean_of_one_that_hides_two_directions_is_flagged() -> None:
    published = {"long": 0.9, "short": 1.2}
    found = red.direction_flags(published, {"long": 0.2, "short": 3.5})
    assert [flag.about for flag in found] == ["long", "short"]
    assert "published 1.2" in found[1].text
    assert red.direction_flags(published, {"long": 0.31, "short": 2.9}) == []


def test_a_gain_of_few_runs_is_luck_and_one_of_all_is_not() -> None:
    base = torch.ones(100, dtype=torch.float64)
    rare = base.clone()
    rare[:4] = 400.0
    won = base * 1.001
    found = red.luck_flags(rare, won)
    assert [flag.kind for flag in found] == ["lucky-runs"]
    assert red.luck_flags(rare, 0.5 * base) == []
    assert red.luck_flags(base, 0.95 * base) == []
    assert red.luck_flags(base[:10], won[:10] * 0.5) == []  # too few to tell


def test_a_value_at_its_bound_is_flagged_unless_it_was_published_there() -> None:
    share = Parameter("share", 0.3, Interval(0.0, 1.0), tuned=True)
    delay = Parameter("delay", 0.0, Bounded(0.0, 2.0), tuned=True)
    both = {"share": share, "delay": delay}
    found = red.value_flags(both, {"share": tensor(0.999), "delay": tensor(0.0)}, {})
    assert [(flag.kind, flag.about, flag.keep) for flag in found] == [
        ("bound", "share", ("share",))
    ]
    assert red.value_flags(both, {"share": tensor(0.5), "delay": tensor(0.4)}, {}) == []
    found = red.value_flags(both, {"share": tensor(0.5), "delay": tensor(2.0)}, {})
    assert [flag.about for flag in found] == ["delay"]


def test_residuals_that_spread_by_9_cm_support_neither_5_7_m_nor_2_m() -> None:
    rng = np.random.default_rng(0)
    errors = tensor(rng.normal(0.0, 0.09, size=(300, 1, 2)))
    errors[..., 0] -= 5.7 - 0.09
    sigma = (tensor([0.1, 0.1]), tensor([2.0, 0.1]))
    owners = {"a": ("a.sigma", "a.bias"), "b": ("b.sigma",)}
    found = red.sensor_flags(errors, sigma, ("a", "b"), tensor([-5.7, 0.0]), owners)
    assert [(flag.kind, flag.about, flag.keep) for flag in found] == [
        ("sensor-off", "a", ("a.sigma",)),
        ("bias", "a", ("a.bias",)),
    ]


def test_training_far_better_than_held_out_is_flagged() -> None:
    assert red.memory_flags((0.7, 0.65, 0.75), (0.9, 0.85, 0.95))
    assert red.memory_flags((0.7, 0.65, 0.87), (0.9, 0.85, 0.95)) == []


def test_a_channel_that_only_the_tuned_filter_rejects_is_switched_off() -> None:
    before, after = {"a": 0.1, "b": 0.7, "c": 0.1}, {"a": 0.6, "b": 0.8, "c": 0.2}
    assert [flag.about for flag in red.refusal_flags(before, after)] == ["a"]


def test_flags_of_one_kind_and_cure_stand_in_one_line() -> None:
    small = tensor([1e-4, 1.0])
    found = red.noise_flags(("x", "vx"), tensor([1.0, 1.0]), small, ("q",))
    assert [flag.about for flag in found] == ["x"]
    both = red.merged(red.noise_flags(("x", "vx"), tensor([1.0, 1.0]), 1e-4 * small, ("q",)))
    assert [flag.about for flag in both] == ["x, vx"]
    assert math.isfinite(float(small[0]))
