"""Channels that are missing, gated or deleted in a step."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import (
    MATRIX,
    MOTION,
    array,
    assert_close,
    linear_filter,
    one,
    plane_belief,
    random_spd,
    tensor,
    textbook_predict,
)
from oracles import textbook
from oracles.regression import weighted_noise

from difffilter.filters.filter import Filter
from difffilter.parameters.parameters import as_number
from difffilter.robust.gate import ACTIONS, Gate
from difffilter.sensors.sensor import FunctionSensor
from difffilter.weights.registry import huber


def only_channels(sigma: object, kept: list[int]) -> Filter:
    h = tensor(MATRIX[kept])
    channels = tuple("abc"[i] for i in kept)
    sensor = FunctionSensor(
        channels,
        lambda x, inputs, values: (h @ x.unsqueeze(-1)).squeeze(-1),
        sigma,  # type: ignore[arg-type]
        name="linear",
    )
    return Filter(MOTION, (sensor,), weight=huber)


@pytest.mark.parametrize("form", ["independent", "full"])
@pytest.mark.parametrize("missing", [[0], [1, 2], [0, 1]])
def test_a_missing_channel_is_a_deleted_channel(
    rng: np.random.Generator, missing: list[int], form: str
) -> None:
    kept = [i for i in range(3) if i not in missing]
    noise = random_spd(rng, 3)
    full = form == "full"
    sigma = as_number(noise.tolist()) if full else (0.5, 1.0, 2.0)
    less = as_number(noise[np.ix_(kept, kept)].tolist()) if full else np.array(sigma)[kept].tolist()
    state, z = plane_belief(rng), tensor([450.0, -300.0, 1.0])
    z_missing = z.clone()
    z_missing[missing] = torch.nan
    found, record = one(linear_filter(sigma, weight=huber), state, z_missing)
    expected, expected_record = one(only_channels(less, kept), state, z[kept])
    assert_close(found.mean, expected.mean, 1e-12)
    assert_close(found.covariance, expected.covariance, 1e-10)
    assert record.present.tolist() == [i in kept for i in range(3)]
    assert not record.weight[missing].any()
    assert not record.innovation[missing].any()
    assert float(record.nis) == pytest.approx(float(expected_record.nis), rel=1e-9)


@pytest.mark.parametrize("iterations", [0, 5])
@pytest.mark.parametrize("mad", [False, True])
@pytest.mark.parametrize("weigh_prior", [False, True])
def test_without_any_channel_the_filter_coasts_on_its_prediction(
    rng: np.random.Generator, iterations: int, mad: bool, weigh_prior: bool
) -> None:
    options = {"mad": mad, "weigh_prior": weigh_prior} if iterations else {}
    filter = linear_filter(weight=huber, iterations=iterations, **options)
    state = plane_belief(rng)
    after, record = one(filter, state, torch.full((3,), torch.nan).double())
    mean, cov = textbook_predict(state, 0.5)
    assert_close(after.mean, mean, 1e-13)
    assert_close(after.covariance, cov, 1e-12)
    assert float(record.nis) == 0.0


@pytest.mark.parametrize("action", ACTIONS)
def test_a_gated_step_is_the_update_at_the_gate_s_weights(
    rng: np.random.Generator, action: str
) -> None:
    filter = linear_filter(weight=huber, gate=Gate(action))
    state = plane_belief(rng)
    mean, cov = textbook_predict(state, 0.5)
    s = np.array([0.5, -2.0, 6.0])
    noise = np.diag([0.25, 1.0, 4.0])
    innovation = s * np.sqrt(np.diag(MATRIX @ cov @ MATRIX.T + noise))
    after, record = one(filter, state, tensor(MATRIX @ mean + innovation))
    assert record.gate.tolist() == [1.0, 1.0, 0.0]
    w = {"reject": (1, 1.345 / 2, 0), "reweigh": (1, 1, 1.345 / 6)}.get(action)
    if w is not None:
        assert_close(record.weight, np.array(w, dtype=float), 1e-10)
    kept = array(record.weight) > 0
    noise = weighted_noise(noise[kept][:, kept], array(record.weight)[kept])
    expected = textbook.kalman_update(mean, cov, innovation[kept], MATRIX[kept], noise)
    assert_close(after.mean, expected[0], 1e-12)
    assert_close(after.covariance, expected[1], 1e-10)


def test_the_inflating_gate_brings_the_nis_down_to_the_threshold(
    rng: np.random.Generator,
) -> None:
    filter, state = linear_filter(gate=Gate("inflate")), plane_belief(rng)
    mean, cov = textbook_predict(state, 0.5)
    noise = np.array([0.25, 1.0, 4.0])
    spread = np.diag(MATRIX @ cov @ MATRIX.T)
    innovation = np.array([0.5, -4.0, 6.0]) * np.sqrt(spread + noise)
    _, record = one(filter, state, tensor(MATRIX @ mean + innovation))
    inflated = innovation**2 / (spread + noise / array(record.weight))
    threshold = float(filter.prepare()["gate.threshold"])
    assert_close(inflated, np.array([0.25, threshold, threshold]), 1e-10)
