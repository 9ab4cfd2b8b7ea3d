"""What a log says: times, silent channels, and errors whose law is known."""

from __future__ import annotations

import math
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from difffilter import ConstantVelocity, Filter, Log, Position, inspect_log, load_scenario
from difffilter.cli.main import main
from difffilter.logs.residuals import correlated, residuals
from difffilter.logs.timing import pulse, timing
from difffilter.scenario.recorded import read_run

Array = NDArray[np.float64]
DATA = Path(__file__).parents[3] / "shared" / "data" / "uwb_ranges"


def gauss_markov(draw: np.random.Generator, rows: int, sigma: float, ratio: float) -> Array:
    """A stationary first-order Gauss-Markov sequence; ``ratio``: interval by correlation time."""
    a = math.exp(-ratio)
    noise = draw.standard_normal(rows)
    found = np.empty(rows)
    found[0] = sigma * noise[0]
    for k in range(1, rows):
        found[k] = a * found[k - 1] + sigma * math.sqrt(1.0 - a * a) * noise[k]
    return found


@pytest.fixture(scope="module")
def worlds() -> list[tuple[dict[str, Any], Any]]:
    """Ten worlds of two channels: bias 2, a shared error of 0.3 and 1 s, white noise of 0.1."""
    found = []
    for seed in range(10):
        draw = np.random.default_rng(seed)
        time = 0.1 * np.arange(3000)
        shared = gauss_markov(draw, 3000, 0.3, 0.1)
        errors = 2.0 + shared[:, None] + 0.1 * draw.standard_normal((3000, 2))
        found.append(residuals(time, errors, ("a", "b")))
    return found


def test_sigma_bias_and_time_of_a_common_error(worlds: Any) -> None:
    within = 0
    for stats, common in worlds:
        assert common is not None
        sound = abs(stats["a"].sigma / math.hypot(0.3, 0.1) - 1.0) < 0.2
        sound &= abs(stats["a"].bias / 2.0 - 1.0) < 0.2
        sound &= abs(common.sigma / 0.3 - 1.0) < 0.2
        sound &= abs(common.time - 1.0) < 0.2
        within += sound
    assert within >= 9


def test_white_noise_does_not_go_on() -> None:
    draw = np.random.default_rng(3)
    errors = draw.standard_normal((1000, 2))
    stats, common = residuals(np.arange(1000.0), errors, ("a", "b"))
    assert common is None
    assert all(r.own.sigma == 0.0 for r in stats.values())
    assert abs(stats["a"].with_others["b"]) < 0.1
    errors[::100] = 50.0
    wild, _ = residuals(np.arange(1000.0), errors, ("a", "b"))
    assert wild["a"].sigma == pytest.approx(stats["a"].sigma, rel=0.05)
    assert wild["a"].tails >= 0.01
    assert wild["a"].largest == 50.0


def test_an_error_of_one_channels_own() -> None:
    draw = np.random.default_rng(5)
    own = gauss_markov(draw, 3000, 1.0, 0.05)
    found = correlated(0.1 * np.arange(3000), own)
    assert found.time == pytest.approx(2.0, rel=0.3)
    assert found.white < 0.1
    assert found.sigma == pytest.approx(1.0, rel=0.2)


def test_times_and_silences() -> None:
    time = np.array([0.0, 1.0, 2.0, 2.0, 1.5, 3.0, 4.0, 30.0, 31.0])
    found = timing(time)
    assert (found.rows, found.duplicates, found.reversals, found.gaps) == (9, 1, 1, 1)
    assert found.longest == (26.0, 4.0)
    values = np.full(100, np.nan)
    assert pulse(np.arange(100.0), values).dead == "no value"
    values[:40] = np.arange(40.0)
    ended = pulse(np.arange(100.0), values)
    assert (ended.count, ended.rate, ended.dead) == (40, 1.0, "ends at 39 s")
    assert pulse(np.arange(100.0), np.ones(100)).dead == "one value in all 100 rows"


def test_proposals_for_a_filter_of_ones_own() -> None:
    """The sensor's published bias is not in the errors, or it would be proposed away."""
    draw = np.random.default_rng(1)
    time = 0.1 * np.arange(800)
    truth = np.stack([time, -time], axis=-1)
    z = truth + np.array([3.0, -1.0]) + 0.5 * draw.standard_normal((800, 2))
    filter = Filter(ConstantVelocity(), (Position(name="p", sigma=1.0, bias=9.0),))
    log = Log(
        filter.channels, torch.from_numpy(time), torch.from_numpy(z),
        truth=torch.from_numpy(truth), truth_states=("x", "y"),
    )  # fmt: skip
    found = inspect_log(log, filter)
    (one,) = found.proposals
    assert one.error is None
    assert one.bias == pytest.approx((3.0, -1.0), abs=0.1)
    assert one.sigma == pytest.approx((0.5, 0.5), rel=0.1)
    document = tomllib.loads(found.toml())["parameters"]["p"]
    assert document["sigma"]["value"] == pytest.approx(one.sigma, rel=1e-3)
    assert document["bias"]["unit"] == "m"


@pytest.mark.skipif(not DATA.is_dir(), reason="the recordings are not there")
def test_recorded_ranges_share_an_error_of_seconds() -> None:
    found = inspect_log(
        read_run(load_scenario("uwb-ranges"), DATA / "los_A1.csv").log, load_scenario("uwb-ranges")
    )
    (one,) = found.proposals
    assert one.common
    assert one.error is not None
    assert one.error.time >= 1.0


def test_command(tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    arguments = ["simulate", "airport-mlat", "--trajectories", "1", "--out", "log.csv"]
    assert main([*arguments, "--seed", "2"]) == 0
    capsys.readouterr()
    assert main(["inspect", "log.csv", "airport-mlat", "--toml", "a.toml", "--plot", "a.png"]) == 0
    told = capsys.readouterr().out
    assert "100 rows" in told
    assert "Proposed for tdoa" in told
    assert tomllib.loads(Path("a.toml").read_text())["parameters"]["tdoa"]["sigma"]["unit"] == "m"
    assert Path("a.png").stat().st_size > 1000
    assert main(["inspect", "log.csv", "--json"]) == 0
    assert main(["inspect", "log.csv", "--toml", "b.toml"]) == 2
    assert not Path("b.toml").exists()
