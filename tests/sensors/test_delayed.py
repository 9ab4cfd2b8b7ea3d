"""A sensor that tells late."""

from __future__ import annotations

import pytest
import torch

import difffilter as df

DELAY = 0.2


def recipe(**more: object) -> df.Filter:
    fix = df.Delayed(df.Position(name="fix", sigma=2.0), delay=DELAY)
    return df.Filter(df.ConstantVelocity(2), (fix,), start_sigma=3.0, **more)  # type: ignore[arg-type]


@pytest.mark.parametrize("rule", ["taylor", "cubature"])
def test_prediction_is_of_the_state_before(rule: str) -> None:
    """H = [I, -d I] of constant velocity, against the update in closed form."""
    filter = recipe(linearise=rule)
    mean = torch.tensor([5.0, 1.0, 20.0, -4.0], dtype=torch.float64)
    begin = df.belief(mean, torch.eye(4, dtype=torch.float64))
    z = torch.tensor([2.0, 1.0], dtype=torch.float64)
    row = df.Measurement(z, torch.tensor(0.0, dtype=torch.float64))
    after, _ = df.step(filter, filter.prepare(), begin, row)
    h = torch.tensor([[1.0, 0.0, -DELAY, 0.0], [0.0, 1.0, 0.0, -DELAY]], dtype=torch.float64)
    s = h @ h.T + 4.0 * torch.eye(2)
    gain = h.T @ torch.linalg.inv(s)
    assert torch.allclose(after.mean, mean + gain @ (z - h @ mean), atol=1e-12)
    assert torch.allclose(after.covariance, torch.eye(4).double() - gain @ h, atol=1e-12)


def test_engine_equals_torch_and_values_may_change() -> None:
    filter = recipe()
    time = torch.arange(30).double() * 0.3
    truth = torch.stack([20.0 * time, torch.zeros(30).double()], -1)
    log = df.Log(filter.channels, time, truth - torch.tensor([4.0, 0.0], dtype=torch.float64))
    start = df.Start(torch.zeros(4).double())
    a, b = (df.run(filter, log, start=start, engine=e) for e in ("torch", "fused"))
    assert torch.allclose(a.mean, b.mean, atol=1e-12)
    assert abs(float(a.mean[-1, 0] - truth[-1, 0])) < 0.5
    late = df.run(filter, log, {"fix.delay": torch.tensor(0.0, dtype=torch.float64)}, start)
    assert abs(float(late.mean[-1, 0] - truth[-1, 0]) + 4.0) < 0.5


def test_any_motion_moves_back() -> None:
    """On a turn the state before is behind on the circle."""
    turn = df.CoordinatedTurn(2, turn_rate=0.5)
    fix = df.Delayed(df.Position(name="fix"), delay=1.0)
    filter = df.Filter(turn, (fix,), start_sigma=1.0)
    state = torch.tensor([0.0, 0.0, 2.0, 0.0], dtype=torch.float64)
    before = filter.sensors[0].predict(state, {}, filter.prepare())
    angle = torch.tensor(-0.5, dtype=torch.float64)
    expected = torch.stack([2.0 * angle.sin() / 0.5, 2.0 * (1.0 - angle.cos()) / 0.5])
    assert torch.allclose(before, expected, atol=1e-12)
