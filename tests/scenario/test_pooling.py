"""Pooled sensors: one measurement from several, weighted by their information."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fusion_cases import SCENES, scene
from helpers import array, assert_close, number, tensor

import difffilter as df
from difffilter.errors import InputError, LogError
from difffilter.logs.logfile import write_log
from difffilter.scenario.pooling import pooled, pooled_sigma
from difffilter.scenario.recorded import load_logs
from difffilter.scenario.scenario import load_scenario

NAN = np.nan
INFORMATION = np.array([1 / 50.0, 1 / 100.0, 1 / 100.0])
FIRST = SCENES[0]


def oracle(z: np.ndarray) -> np.ndarray:
    """(..., 8): x and y of the pooled sensor from those of the three others."""
    z = z.copy()
    for axis in range(2):
        parts = z[..., axis:6:2]
        level = np.where(np.isnan(parts), 0.0, INFORMATION)
        with np.errstate(invalid="ignore"):
            z[..., 6 + axis] = (level * np.nan_to_num(parts)).sum(-1) / level.sum(-1)
    return z


def test_a_pooled_value_is_the_mean_of_what_is_present_by_information() -> None:
    scenario = load_scenario(FIRST)
    rng = np.random.default_rng(2)
    z = 100.0 * rng.standard_normal((40, 8))
    z[:, :6][rng.random((40, 6)) < 0.4] = NAN
    z[7, :6] = NAN
    found, weights = pooled(scenario.sensors, scenario.channels, tensor(z))
    expected = oracle(z)
    assert np.isnan(expected[7, 6:]).all()
    assert np.isnan(expected[:, 6]).sum() < 10
    np.testing.assert_allclose(array(found), expected, rtol=1e-13)
    assert weights[6].tolist() == pytest.approx([0.5, 0.0, 0.25, 0.0, 0.25, 0.0, 0.0, 0.0])
    assert torch.equal(weights[:6], torch.eye(8).double()[:6])


def test_the_noise_of_a_pooled_sensor_is_what_its_members_leave() -> None:
    scenario = load_scenario(FIRST)
    members = [scenario.sensors[name] for name in ("r", "a1", "a2")]
    assert pooled_sigma(members) == pytest.approx(5.0)
    assert scenario.sensors["pooled"].sigma == pytest.approx(5.0)
    _, log = scene(FIRST)
    assert log.truth is not None
    at = log.channels.index("x_pooled")
    noise = log.z[..., at : at + 2] - log.truth[..., :2]
    assert number(noise.std()) == pytest.approx(5.0, rel=0.1)


@pytest.mark.parametrize("name", SCENES)
def test_in_a_simulated_log_the_pooled_channels_are_those_of_the_others(name: str) -> None:
    _, log = scene(name)
    assert_close(log.z, oracle(array(log.z)), 1e-13)


def test_a_clairvoyant_filter_is_told_of_the_faults_mean_and_variance_in_the_pool() -> None:
    scenario = load_scenario(
        SCENES[1],
        {
            "faults.extra": {
                "kind": "offset", "channels": ["x_a1"], "windows": [[40, 40]],
                "distribution": "uniform", "low": 0.0, "high": 60.0,
            }
        },
    )  # fmt: skip
    log = df.simulate(scenario, 2, 3)
    mean, variance = log.inputs["fault.mean"], log.inputs["fault.variance"]
    for row, offset in ((79, 400.0), (104, 300.0)):
        assert_close(mean[row], np.full((2, 8), offset), 1e-13)
        assert not variance[row].any()
    assert mean[39, 0].tolist() == pytest.approx([0.0, 0.0, 30.0, 0.0, 0.0, 0.0, 7.5, 0.0])
    assert variance[39, 0].tolist() == pytest.approx([0.0, 0.0, 300, 0.0, 0.0, 0.0, 18.75, 0.0])


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (
            {"sensors.pooled.pool": ["r", "a3"]},
            "pool: found ['r', 'a3'], expected other sensors among r, a1, a2, pooled",
        ),
        ({"sensors.pooled.pool": ["r", "pooled"]}, "expected other sensors among r, a1, a2, poo"),
        (
            {"sensors.more": {"kind": "position", "channels": ["a", "b"], "pool": ["r", "pooled"]}},
            "sensors.more.pool: found ['r', 'pooled'], expected other sensors among r, a1, a2",
        ),
        (
            {
                "sensors.more": {"kind": "range", "stations": [[0.0, 0.0], [1.0, 0.0], [2.0, 5.0]]},
                "sensors.pooled.pool": ["r", "more"],
            },
            "sensors.pooled.pool: found ['r', 'more'], expected sensors of as many channels",
        ),
        ({"sensors.pooled.pool": "r"}, "sensors.pooled.pool: found 'r', expected a list of texts"),
    ],
)
def test_a_wrong_pool_is_named(overrides: dict[str, object], message: str) -> None:
    with pytest.raises(InputError) as caught:
        load_scenario(FIRST, overrides)
    assert message in str(caught.value)


def test_a_log_without_the_pooled_columns_is_completed_when_it_is_loaded(tmp_path: Path) -> None:
    scenario, log = scene(FIRST)
    z = log.z[:, 0].clone()
    z[4, :6], z[9, 2:4] = torch.nan, torch.nan
    assert log.truth is not None
    whole = replace(log, z=z, truth=log.truth[:, 0], inputs={}, names=(), start=None)
    short = replace(whole, channels=log.channels[:6], z=z[:, :6])
    path = tmp_path / "short.csv"
    write_log(path, short)
    found = load_logs(scenario, [path])
    assert found.channels == scenario.channels
    np.testing.assert_allclose(array(found.z[:, 0]), oracle(array(z)), rtol=1e-9)
    assert bool(torch.isnan(found.z[4, 0]).all())
    own = tmp_path / "own.csv"  # a file with the columns keeps its own values
    changed = z.clone()
    changed[:, 6:] = 7.0
    write_log(own, replace(whole, z=changed))
    assert bool((load_logs(scenario, [own]).z[..., 6:] == 7.0).all())
    write_log(path, replace(short, channels=log.channels[:4], z=z[:, :4]))
    with pytest.raises(LogError, match="x_a2"):  # a member is no derived column
        load_logs(scenario, [path])
