"""A step with groups: one weight and one gate for all channels of a group."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from group_cases import (
    CHANNELS,
    GROUPS,
    INNOVATIONS,
    NOISES,
    SCOPES,
    H,
    problem,
    squares,
    two_sensors,
)
from helpers import STATIONS, array, assert_close, one, plane_belief, tdoa_filter
from helpers import predicted_z as noise_free
from oracles import chi_square
from oracles import groups as oracle
from oracles import weights as published

from difffilter.core.beliefs import Measurement
from difffilter.filters.stepping import step
from difffilter.robust.gate import ACTIONS, Gate
from difffilter.robust.groups import DISTANCES
from difffilter.sensors.builtin import TDOA
from difffilter.weights.registry import WEIGHTS, cauchy, huber, igg3

WEIGH: dict[str, Callable[..., np.ndarray]] = {
    "huber": published.huber,
    "cauchy": published.cauchy,
}


@pytest.mark.parametrize("iterations", [0, 4])
@pytest.mark.parametrize("standardise", ["innovation", "noise"])
@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize("noise", list(NOISES))
@pytest.mark.parametrize("scope", list(SCOPES))
@pytest.mark.parametrize("missing", list(INNOVATIONS))
def test_each_group_has_the_one_weight_of_its_distance(
    rng: np.random.Generator,
    scope: str,
    noise: str,
    distance: str,
    standardise: str,
    iterations: int,
    missing: str,
) -> None:
    name = "cauchy" if distance == "rms" else "huber"
    filter = two_sensors(
        noise,
        weight=WEIGHTS[name],
        scope=SCOPES[scope],
        distance=distance,
        standardise=standardise,
        iterations=iterations,
    )
    state = plane_belief(rng)
    mean, cov, innovation, z = problem(state, INNOVATIONS[missing], noise)
    after, record = one(filter, state, z)
    parts = (mean, cov, innovation, H, NOISES[noise], GROUPS[scope], WEIGH[name])
    expected = oracle.group_update(*parts, standardise, distance, iterations)
    for group in GROUPS[scope]:
        here = [i for i in group if np.isfinite(innovation[i])]
        assert len(set(record.weight[here].tolist())) <= 1
    assert_close(record.weight, expected[2], 1e-9)
    assert_close(after.mean, expected[0], 1e-10)
    assert_close(after.covariance, expected[1], 1e-9)


@pytest.mark.parametrize("iterations", [0, 3])
@pytest.mark.parametrize("noise", list(NOISES))
@pytest.mark.parametrize("scope", list(SCOPES))
@pytest.mark.parametrize("missing", list(INNOVATIONS))
def test_the_gate_rejects_or_passes_a_whole_group_at_its_number_of_present_channels(
    rng: np.random.Generator, scope: str, noise: str, missing: str, iterations: int
) -> None:
    filter = two_sensors(noise, scope=SCOPES[scope], gate=Gate("reject"), iterations=iterations)
    groups, shape = GROUPS[scope], INNOVATIONS[missing]
    state = plane_belief(rng)
    _, cov, innovation, _ = problem(state, shape, noise)
    covariance = H @ cov @ H.T + NOISES[noise]
    nis = squares(innovation, covariance, scope)
    for group in groups:
        here = [i for i in group if np.isfinite(innovation[i])]
        if not here:
            continue
        limit = chi_square.quantile(0.005, len(here))
        for factor, passes in ((1 - 1e-6, 1.0), (1 + 1e-6, 0.0)):
            sigmas = shape * np.sqrt(limit / nis[here[0]]) * np.sqrt(factor)
            *_, z = problem(state, sigmas, noise)
            _, record = one(filter, state, z)
            assert record.gate[here].tolist() == [passes] * len(here)
            assert record.weight[here].tolist() == [passes] * len(here)


@pytest.mark.parametrize("action", ACTIONS)
def test_a_gated_group_s_step_is_the_update_at_its_weights(
    rng: np.random.Generator, action: str
) -> None:
    gated = two_sensors("mixed", weight=huber, scope="sensor", gate=Gate(action))
    state = plane_belief(rng)
    sigmas = np.array([0.2, 0.1, 1.0, 9.0, -0.3])
    mean, cov, innovation, z = problem(state, sigmas, "mixed")
    after, record = one(gated, state, z)
    assert record.gate.tolist() == [1, 1, 0, 0, 0]
    nominal = H @ cov @ H.T + NOISES["mixed"]
    robust = published.huber(
        oracle.distances(innovation, nominal, np.diag(nominal), GROUPS["sensor"], "rms")
    )
    limit = chi_square.quantile(0.005, 3)
    excess = squares(innovation, nominal, "sensor") / limit - 1.0
    share = np.diag(NOISES["mixed"]) / np.diag(nominal)
    of_failed = {"reject": 0.0 * robust, "reweigh": robust}
    failed = of_failed.get(action, robust * share / (share + excess))
    passed = np.ones(5) if action == "reweigh" else robust
    weights = np.where([True, True, False, False, False], passed, failed)
    assert_close(record.weight, weights, 1e-8)
    expected = oracle.update(mean, cov, innovation, H, NOISES["mixed"], weights)
    assert_close(after.mean, expected[0], 1e-9)
    assert_close(after.covariance, expected[1], 1e-9)


@pytest.mark.parametrize("iterations", [0, 3])
@pytest.mark.parametrize("distance", DISTANCES)
def test_groups_of_one_channel_are_scope_channel_exactly(
    rng: np.random.Generator, distance: str, iterations: int
) -> None:
    state = plane_belief(rng)
    *_, z = problem(state, INNOVATIONS["some missing"], "mixed")
    options = {"weight": igg3, "gate": Gate("reweigh"), "iterations": iterations}
    alone = {f"group {name}": (name,) for name in CHANNELS}
    after, record = one(two_sensors("mixed", scope=alone, distance=distance, **options), state, z)
    plain, plain_record = one(two_sensors("mixed", **options), state, z)
    assert torch.equal(after.mean, plain.mean)
    assert torch.equal(after.deviations, plain.deviations)
    for ours, theirs in zip(record, plain_record, strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize("standardise", ["innovation", "noise"])
def test_noise_common_to_channels_counts_in_a_group_s_distance(
    rng: np.random.Generator, standardise: str, distance: str
) -> None:
    sensor = TDOA(stations=STATIONS, sigma=3.0, common_sigma=2.0)
    filter = tdoa_filter(
        sensor=sensor, weight=cauchy, scope="all", distance=distance, standardise=standardise
    )
    state = plane_belief(rng)
    innovation = np.array([2.0, -4.0, 40.0, np.nan, 5.5, -9.0, 14.0])
    z = noise_free(filter, state, 0.5, filter.prepare())
    z = z + torch.tensor(innovation)
    _, record = one(filter, state, z)
    noise = 9.0 * np.eye(7) + 4.0
    prediction = array(record.observed)[:, :4]  # before the column of common noise
    base = noise + (prediction @ prediction.T if standardise == "innovation" else 0.0)
    s = oracle.distances(innovation, base, np.diag(base), [range(7)], distance)
    assert_close(record.weight, published.cauchy(s) * np.isfinite(innovation), 1e-9)


@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize("noise", list(NOISES))
def test_without_any_channel_groups_leave_the_prediction(
    rng: np.random.Generator, noise: str, distance: str
) -> None:
    filter = two_sensors(noise, weight=cauchy, scope="sensor", distance=distance, gate=Gate())
    state = plane_belief(rng)
    mean, cov, _, z = problem(state, np.full(5, np.nan), noise)
    after, _ = one(filter, state, z)
    assert_close(after.mean, mean, 1e-13)
    assert_close(after.covariance, cov, 1e-12)


@pytest.mark.parametrize("distance", DISTANCES)
def test_a_batch_of_groups_is_each_trajectory_by_itself(
    rng: np.random.Generator, distance: str
) -> None:
    options = {"weight": huber, "scope": "sensor", "distance": distance, "gate": Gate("reweigh")}
    filter = two_sensors(**options)
    states = plane_belief(rng, 3)
    singles = [type(states)(*(x[i] for x in states[:2])) for i in range(3)]
    shapes = list(INNOVATIONS.values())
    z = torch.stack([problem(singles[i], shapes[i], "independent")[3] for i in range(3)])
    constants = filter.prepare()
    after, record = step(
        filter, constants, states, Measurement(z, torch.tensor(0.5, dtype=torch.float64))
    )
    for i, single in enumerate(singles):
        alone, alone_record = one(filter, single, z[i])
        assert_close(after.mean[i], alone.mean, 1e-12)
        assert_close(record.weight[i], alone_record.weight, 1e-12)
