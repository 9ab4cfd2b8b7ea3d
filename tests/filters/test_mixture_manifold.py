"""Mixtures of states that are no vectors: headings that wrap, attitudes."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from attitude_cases import attitude
from helpers import array, assert_close, tensor
from torch import Tensor

from difffilter import (
    Belief,
    Filter,
    FunctionMotion,
    FunctionSensor,
    InputError,
    Log,
    Mixture,
    Start,
    run,
    wrap,
)
from difffilter.engine.build import compiler
from difffilter.motions import quaternion

ENGINES = ["torch", pytest.param("fused", marks=pytest.mark.skipif(not compiler(), reason="cc"))]


def turning(drift: float, wraps: bool) -> Filter:
    """A heading that a compass reads modulo a whole turn, and that drifts."""

    def ahead(x: Tensor, dt: Tensor, inputs: object, values: object) -> Tensor:
        return x + drift * dt.unsqueeze(-1)

    def noise(dt: Tensor, values: object) -> Tensor:
        return (0.05 * dt.sqrt())[..., None, None]

    ways = {}
    if wraps:
        ways = {
            "retract_function": lambda x, s: wrap(x + s, torch.zeros(())),
            "local_function": lambda a, b: wrap(b, a),
        }
    motion = FunctionMotion(("heading",), ahead, noise, kinds={"heading": "angle"}, **ways)  # type: ignore[arg-type]
    compass = FunctionSensor(
        ("compass",), lambda x, i, v: x, sigma=0.2, name="compass", residual_function=wrap
    )
    return Filter(motion, (compass,))


def both(wraps: bool) -> Mixture:
    return Mixture({"left": turning(0.4, wraps), "right": turning(-0.4, wraps)}, rate=0.2)


@pytest.mark.parametrize("engine", ENGINES)
def test_a_heading_that_wraps_is_the_heading_that_does_not(engine: str) -> None:
    rng = np.random.default_rng(5)
    time = tensor(np.arange(1.0, 25.0))
    rate = np.where(np.arange(24) < 16, 0.4, -0.4)
    seen = 2.5 + np.cumsum(rate) + 0.2 * rng.standard_normal(24)
    log = Log(("compass",), time, wrap(tensor(seen), torch.zeros(())).unsqueeze(-1))
    start = Start(tensor([2.5]), tensor([[0.04]]), 0.0)
    found = run(both(True), log, start=start, engine=engine)
    expected = run(both(False), log, start=start, engine="torch")
    assert float(found.mean.abs().max()) <= np.pi
    assert float(expected.mean.max()) > 2 * np.pi
    assert float(wrap(found.mean - expected.mean, torch.zeros(())).abs().max()) < 1e-9
    assert_close(found.covariance, array(expected.covariance), 1e-9)
    assert found.record is not None
    assert expected.record is not None
    assert_close(found.record.modes, array(expected.record.modes), 1e-9)


FIELDS = {"a": (0.0, 0.0, 9.81), "m": (0.4, 0.0, 0.9)}


def seen_turned(gyro: float, turn: Tensor) -> Filter:
    """An attitude by two fields; the reference turned by a quaternion."""
    fields = {name: array(quaternion.rotate(turn, tensor(f))) for name, f in FIELDS.items()}
    return attitude(fields, gyro, (0.2, 0.2))


def moving(seed: int = 2, steps: int = 5) -> tuple[Log, Tensor]:
    rng = np.random.default_rng(seed)
    rates = tensor(rng.standard_normal((steps, 3)))
    q = quaternion.exponential(tensor([0.3, -0.2, 2.0]))
    start, rows = q, []
    for k in range(steps):
        slip = 2.0 * (k > steps // 2) * torch.ones(3).double()
        q = quaternion.retract(q, 0.1 * (rates[k] + slip))
        rows.append(torch.cat([quaternion.rotate_back(q, tensor(f)) for f in FIELDS.values()]))
    z = torch.stack(rows) + 0.2 * tensor(rng.standard_normal((steps, 6)))
    inputs = {f"w{axis}": rates[:, i] for i, axis in enumerate("xyz")}
    channels = tuple(f"{name}{axis}" for name in FIELDS for axis in "xyz")
    return Log(channels, 0.1 * torch.arange(1, steps + 1).double(), z, inputs=inputs), start


def test_equal_modes_of_an_attitude_are_the_plain_filter() -> None:
    log, q = moving()
    one = quaternion.exponential(torch.zeros(3).double())
    start = Belief(quaternion.retract(q, tensor([0.2, 0.1, -0.2])), 0.3 * torch.eye(3).double())
    filter = seen_turned(0.05, one)
    expected = run(filter, log, start=start, engine="torch")
    found = run(Mixture({"a": filter, "b": filter}), log, start=start, engine="torch")
    assert_close(found.mean, array(expected.mean), 1e-12)
    assert_close(found.covariance, array(expected.covariance), 1e-12)


def test_a_mixture_of_attitudes_does_not_depend_on_the_reference() -> None:
    log, q = moving()
    tracks = []
    turns = [quaternion.exponential(tensor(v)) for v in ([0.0, 0.0, 0.0], [1.0, -2.0, 0.5])]
    for turn in turns:
        mixture = Mixture(
            {"calm": seen_turned(0.02, turn), "slips": seen_turned(1.0, turn)}, own=("gyro.*",)
        )
        begin = quaternion.product(turn, quaternion.retract(q, tensor([0.2, 0.1, -0.2])))
        start = Belief(begin, 0.3 * torch.eye(3).double())
        tracks.append(run(mixture, log, start=start, engine="torch"))
    first, other = tracks
    turned = quaternion.product(turns[1].expand_as(first.mean), first.mean)
    assert float(quaternion.local(turned, other.mean).abs().max()) < 1e-9
    assert_close(other.covariance, array(first.covariance), 1e-9)
    assert first.record is not None
    assert float(first.record.modes[-1, 1]) > 0.9 > 0.6 > float(first.record.modes[1, 1])


def test_modes_of_other_tangents_are_an_input_error() -> None:
    with pytest.raises(InputError, match=r"modes\.b: found a state whose deviations are heading"):
        Mixture({"a": turning(0.1, True), "b": turning(0.1, False)})
