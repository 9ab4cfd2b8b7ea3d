"""Simulated logs: determinism, disjoint purposes, streams of their own, statistics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import array, assert_close
from oracles import airport
from torch import Tensor

from difffilter.errors import InputError
from difffilter.logs.log import Log
from difffilter.scenario.scenario import Scenario, load_scenario
from difffilter.scenario.simulation import simulate
from difffilter.seeds import stream

QUIET = {"faults.nlos.probability": 0.0}


def world(**overrides: object) -> Scenario:
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    return load_scenario("airport-mlat-intermittent", {"world.steps": 40} | keys)


def exact(log: Log) -> np.ndarray:
    assert log.truth is not None
    return airport.range_differences(array(log.truth))


def parts(log: Log) -> list[Tensor]:
    assert log.truth is not None
    assert log.start is not None
    # The ideal process noise is NaN where it is the filter's own.
    inputs = [value.nan_to_num(-1.0) for value in log.inputs.values()]
    return [log.z, log.truth, log.time, log.start.mean, *inputs]


def test_the_same_seed_gives_the_same_log_whatever_the_global_generator() -> None:
    torch.manual_seed(1)
    first = simulate(world(), 4, seed=7)
    torch.manual_seed(2)
    before = torch.get_rng_state()
    second = simulate(world(), 4, seed=7)
    assert torch.equal(torch.get_rng_state(), before)
    for a, b in zip(parts(first), parts(second), strict=True):
        assert torch.equal(a, b)
    assert first.names == second.names


@pytest.mark.parametrize(
    ("one", "other"),
    [((7, "train"), (8, "train")), ((7, "train"), (7, "test")), ((1, "1"), (11, ""))],
)
def test_seeds_and_purposes_share_no_number(one: tuple[int, str], other: tuple[int, str]) -> None:
    a, b = (simulate(world(), 4, *key) for key in (one, other))
    assert not (a.z == b.z).any()
    assert a.truth is not None
    assert b.truth is not None
    assert not (a.truth[1:, :, 3] == b.truth[1:, :, 3]).any()
    assert a.start is not None
    assert b.start is not None
    assert not (a.start.mean[:, :2] == b.start.mean[:, :2]).any()
    common = np.intersect1d(array(a.z), array(b.z))
    assert common.size == 0


def test_streams_depend_on_seed_and_purpose_alone() -> None:
    def draw(*key: object) -> Tensor:
        return torch.rand(5, generator=stream(*key))  # type: ignore[arg-type]

    assert torch.equal(draw(3, "fault", "nlos"), draw(3, "fault", "nlos"))
    others = [draw(3, "fault", "nlos"), draw(3, "fault"), draw(4, "fault", "nlos"), draw(3)]
    assert len({tuple(other.tolist()) for other in others}) == 4


def test_rows_are_the_steps_from_one_on_and_the_start_is_at_time_zero() -> None:
    log = simulate(world(), 3, seed=1)
    assert log.z.shape == (40, 3, 7)
    assert_close(log.time, 0.1 * np.arange(1, 41), 1e-15)
    assert log.start is not None
    assert log.start.time == 0.0
    assert log.start.covariance is None
    assert log.truth_states == ("x", "y", "vx", "vy")
    assert len(set(log.names)) == 3


def test_noise_is_white_normal_and_as_large_as_declared() -> None:
    log = simulate(world(faults__nlos__probability=0.0), 300, seed=5)
    noise = (array(log.z) - exact(log)) / airport.metres(10.0)
    flat = noise.reshape(-1, 7)
    count = len(flat)
    assert np.abs(flat.mean(0)).max() < 5 / count**0.5
    assert np.abs(flat.std(0) - 1).max() < 5 / (2 * count) ** 0.5
    correlation = np.corrcoef(flat.T) - np.eye(7)
    assert np.abs(correlation).max() < 5 / count**0.5
    assert abs((noise[1:] * noise[:-1]).mean()) < 5 / noise.size**0.5
    assert abs((flat**4).mean() - 3) < 5 * (96 / flat.size) ** 0.5


def test_the_reference_stations_noise_is_common_to_all_differences() -> None:
    scenario = world(faults__nlos__probability=0.0, sensors__tdoa__noise__common_sigma=20.0)
    log = simulate(scenario, 300, seed=5)
    noise = ((array(log.z) - exact(log)) / airport.metres(1.0)).reshape(-1, 7)
    covariance = noise.T @ noise / len(noise)
    assert_close(covariance, 100.0 * np.eye(7) + 400.0, 0.05)


def test_a_schedule_changes_the_noise_between_its_steps_only() -> None:
    schedule = [{"first": 11, "last": 20, "sigma": 100.0}, {"first": 35, "last": 99, "sigma": 1.0}]
    keys = {"sensors.tdoa.noise.schedule": schedule, **QUIET}
    log = simulate(world().with_overrides(keys), 200, seed=5)
    level = (array(log.z) - exact(log)).std((1, 2)) / airport.metres(1.0)
    expected = np.full(40, 10.0)
    expected[10:20], expected[34:] = 100.0, 1.0
    assert np.abs(level / expected - 1).max() < 5 / (2 * 200 * 7) ** 0.5


def test_the_start_errs_by_the_sigma_of_the_scenario() -> None:
    keys = {"start.velocity_sigma": 0.5, "world.steps": 1}
    log = simulate(world().with_overrides(keys), 2000, seed=5)
    assert log.start is not None
    error = array(log.start.mean) - airport.START
    assert np.abs(error.std(0) / [3.0, 3.0, 0.5, 0.5] - 1).max() < 5 / 4000**0.5
    assert np.abs(error.mean(0) / [3.0, 3.0, 0.5, 0.5]).max() < 5 / 2000**0.5


def test_a_scenario_that_starts_from_measurements_prescribes_no_start() -> None:
    assert simulate(world(start__kind="measurements"), 2).start is None


@pytest.mark.parametrize(
    "change",
    [
        {"faults.nlos.probability": 0.7},
        {"faults.nlos.scale": 3.0},
        {"faults.more": {"kind": "dropout", "probability": 0.2}},
        {"faults.more": {"kind": "zero", "windows": [[3, 5]]}},
    ],
)
def test_changing_a_fault_leaves_all_other_draws_as_they_were(change: dict[str, object]) -> None:
    before, after = (
        simulate(world(), 5, seed=3),
        simulate(world().with_overrides(change), 5, seed=3),
    )
    clean = simulate(world(faults__nlos__probability=0.0), 5, seed=3)
    assert before.truth is not None
    assert after.truth is not None
    assert torch.equal(before.truth, after.truth)
    assert before.start is not None
    assert after.start is not None
    assert torch.equal(before.start.mean, after.start.mean)
    untouched = (after.inputs["fault.variance"] == 0) & ~after.z.isnan()
    assert bool(untouched.any())
    assert torch.equal(after.z[untouched], clean.z[untouched])
    assert not torch.equal(after.z, before.z)


def test_two_faults_strike_independently_of_each_other() -> None:
    twin = {"kind": "zero", "probability": 0.1}
    log = simulate(world(faults__twin=twin), 200, seed=3)
    zeroed, delayed = log.inputs["fault.variance"].isinf(), log.inputs["fault.mean"] != 0
    both, count = float((zeroed & delayed).double().mean()), zeroed.numel()
    assert both == pytest.approx(0.01, abs=5 * (0.01 / count) ** 0.5)
    assert float(zeroed.double().mean()) == pytest.approx(0.1, abs=5 * (0.09 / count) ** 0.5)


def test_changing_the_noise_leaves_the_faults_as_they_were() -> None:
    loud, soft = world(sensors__tdoa__noise__sigma=30.0), world()
    a, b = simulate(loud, 5, seed=3), simulate(soft, 5, seed=3)
    assert torch.equal(a.inputs["fault.variance"], b.inputs["fault.variance"])
    noise_a, noise_b = array(a.z) - exact(a), array(b.z) - exact(b)
    clean = array(a.inputs["fault.variance"]) == 0
    assert_close(noise_a[clean], 3.0 * noise_b[clean], 1e-9)


@pytest.mark.parametrize(("n_l", "p"), [(5.0, 1.0), (100.0, 0.1)])
def test_the_airports_statistics_are_those_of_the_oracle(n_l: float, p: float) -> None:
    keys = {"faults.nlos.scale": n_l, "faults.nlos.probability": p}
    log = simulate(world().with_overrides(keys), 400, seed=9)
    assert log.truth is not None
    assert log.start is not None
    theirs = airport.simulate(np.random.default_rng(9), 400, 40, n_l_ns=n_l, p=p)
    truth = np.swapaxes(theirs["truth"], 0, 1)[1:]
    ours = array(log.truth)
    for k in (0, 20, 39):
        spread = truth[k].std(0) / 400**0.5
        assert (np.abs(ours[k].mean(0) - truth[k].mean(0)) <= 5 * 2**0.5 * spread + 1e-9).all()
        assert_close(ours[k].std(0), truth[k].std(0), 0.15)
    errors = array(log.z) - exact(log)
    other = np.swapaxes(theirs["measurements"], 0, 1)[1:] - airport.range_differences(truth)
    edges = np.linspace(-15.0, 40.0, 200)
    mine, reference = (np.searchsorted(np.sort(x, None), edges) / x.size for x in (errors, other))
    assert np.abs(mine - reference).max() < 2.0 * (2.0 / errors.size) ** 0.5  # Kolmogorov-Smirnov
    assert errors.mean() == pytest.approx(p * 0.75 * airport.metres(n_l), rel=0.05)


def test_only_worlds_are_simulated() -> None:
    with pytest.raises(InputError, match=r"uwb-ranges: has no \[world\]"):
        simulate(load_scenario("uwb-ranges"))
    with pytest.raises(InputError, match="trajectories: found 0, expected 1 or more"):
        simulate(world(), 0)


def test_the_log_can_be_cut_and_keeps_what_a_clairvoyant_is_told() -> None:
    log = simulate(world(), 5, seed=3)
    part = log.select([4, 1])
    for name in ("fault.mean", "fault.variance"):
        assert torch.equal(part.inputs[name], log.inputs[name][:, [4, 1]])
    assert part.names == (log.names[4], log.names[1])
    assert replace(part, names=()).trajectories == 2


def urban(**overrides: object) -> Scenario:
    keys = {key.replace("__", "."): value for key, value in overrides.items()}
    return load_scenario("urban-credibility", {"world.steps": 40} | keys)


SCHEDULE = [{"first": 11, "last": 25, "sigma": 10.0}, {"first": 20, "last": 22, "sigma": 7.0}]


def test_an_ideal_filter_is_told_the_true_errors_and_variances() -> None:
    log = simulate(urban(sensors__position_1__noise__schedule=SCHEDULE), 400, seed=4)
    assert log.truth is not None
    error = array(log.z) - array(log.truth[..., :1])
    assert_close(log.inputs["ideal.error"], error, 1e-12)
    sigma = np.full((40, 2), 3.0)
    sigma[10:25, 0], sigma[19:22, 0], sigma[:, 1] = 10.0, 7.0, 5.0
    assert_close(log.inputs["ideal.variance"], np.repeat(sigma[:, None] ** 2, 400, axis=1), 1e-15)
    measured = (error / sigma[:, None]).std(1)
    assert np.abs(measured - 1.0).max() < 5.0 / (2 * 400) ** 0.5


def test_an_ideal_filter_is_told_of_faults_too_and_of_gaps_nothing() -> None:
    fault = {"kind": "offset", "channels": ["position_1"], "windows": [[5, 8]], "value": 50.0,
             "distribution": "constant"}  # fmt: skip
    gap = {"kind": "dropout", "channels": ["position_2"], "windows": [[3, 4]]}
    faulty = simulate(urban(faults__off=fault, faults__gap=gap), 3, seed=4)
    clean = simulate(urban(), 3, seed=4)
    added = array(faulty.inputs["ideal.error"] - clean.inputs["ideal.error"])
    assert_close(added[4:8, :, 0], np.full((4, 3), 50.0), 1e-12)
    assert not faulty.inputs["ideal.error"][2:4, :, 1].any()
    assert bool(faulty.z[2:4, :, 1].isnan().all())


def test_the_ideal_process_noise_is_told_where_it_is_given() -> None:
    levels = [{"first": 5, "last": 9, "acceleration": 3.0}, {"first": 9, "last": 90,
               "acceleration": 1.5}]  # fmt: skip
    told = simulate(urban(world__ideal_process=levels), 2).inputs["ideal.process"]
    assert told.shape == (40, 2)
    assert bool(told[:4].isnan().all())
    assert told[4:, 0].tolist() == [3.0] * 4 + [1.5] * 32
    assert torch.equal(told[4:, 0], told[4:, 1])
    none = simulate(urban(world__ideal_process=[]), 2).inputs["ideal.process"]
    assert bool(none.isnan().all())


@pytest.mark.parametrize("every", [2, 5])
def test_a_slow_sensor_measures_at_every_so_many_th_step(every: int) -> None:
    slow = simulate(urban(sensors__position_2__every=every), 3, seed=4)
    fast = simulate(urban(), 3, seed=4)
    steps = torch.arange(1, 41)
    there = steps % every == 0
    assert torch.equal(slow.present[..., 1], there[:, None].expand(40, 3))
    assert bool(slow.present[..., 0].all())
    assert torch.equal(slow.z[there], fast.z[there])
    assert torch.equal(slow.z[..., 0], fast.z[..., 0])
    assert bool(torch.isfinite(slow.inputs["ideal.error"]).all())
