"""What users write in their own sensors goes through the engine, or torch runs after a word."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from difffilter import ConstantVelocity, Filter, FunctionSensor, Log, Start, Tracker, run, tanh
from difffilter.engine import notice, program
from difffilter.engine.build import compiler
from difffilter.engine.choice import eager_seconds, pick, settled
from difffilter.engine.kernels import width_for
from difffilter.errors import EngineError, InputError
from difffilter.sensors.position import PositionSensor

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

D = torch.float64
MIX = torch.tensor([[1.0, 0.2, 0.0, 0.1], [0.0, 1.0, 0.3, 0.0]], dtype=D)


def log_of(filter: Filter, rows: int = 12) -> Log:
    time = torch.arange(rows, dtype=D)
    z = torch.randn(rows, len(filter.channels), generator=torch.Generator().manual_seed(1), dtype=D)
    start = Start(torch.tensor([-3.0, 4.0, 0.1, -0.2], dtype=D), torch.eye(4, dtype=D))
    return Log(filter.channels, time, 1.0 + 0.1 * z, start=start)


def assert_engines_agree(filter: Filter) -> None:
    log = log_of(filter)
    slow, fast = (run(filter, log, engine=engine) for engine in ("torch", "fused"))
    torch.testing.assert_close(fast.mean, slow.mean, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(fast.covariance, slow.covariance, rtol=1e-7, atol=1e-7)


def written(s: Tensor, inputs: object, values: object) -> Tensor:
    """Much of what a model may be made of."""
    p, v = torch.split(s, [2, 2], dim=-1)
    pulled = F.linear(s, MIX, MIX[:, 0])
    gain = torch.eye(2, dtype=s.dtype) + torch.diag_embed(p.square())
    solved = torch.linalg.solve(gain, v)
    lower = torch.linalg.cholesky(gain)
    return torch.stack(
        [
            torch.hypot(p[..., 0], p[..., 1]) + torch.erf(v[..., 0]),
            p.norm(dim=-1) ** 3 / 100.0 + F.softplus(v[..., 1]),
            torch.atan(p[..., 0]) + torch.asin(v[..., 0].clamp(-0.9, 0.9)),
            (pulled.roll(1, -1) * s[..., :2].flip(-1)).sum(-1) / 10.0,
            torch.einsum("ij,...j->...i", MIX, s).tanh().sum(-1) + solved.sum(-1),
            (torch.linalg.inv(gain) @ v.unsqueeze(-1)).squeeze(-1).sum(-1) + lower[..., 1, 1],
        ],
        dim=-1,
    )


def test_a_model_of_many_operations() -> None:
    sensor = FunctionSensor(tuple("abcdef"), written, sigma=1.0)
    assert_engines_agree(Filter(ConstantVelocity(), (sensor,), tanh))


def test_the_range_of_a_target_with_negative_coordinates() -> None:
    def distance(s: Tensor, inputs: object, values: object) -> Tensor:
        return s[..., :2].square().sum(-1, keepdim=True).sqrt()

    filter = Filter(ConstantVelocity(), (FunctionSensor(("r",), distance, sigma=1.0),))
    trackers = [
        Tracker(filter, [-3.0, 4.0, 0.0, 0.0], torch.eye(4, dtype=D), engine=engine)
        for engine in ("torch", "fused")
    ]
    for tracker in trackers:
        tracker.step(torch.tensor([5.5], dtype=D), dt=1.0)
    torch.testing.assert_close(trackers[1].belief.mean, trackers[0].belief.mean)


@dataclass(frozen=True, kw_only=True)
class Bistatic(PositionSensor):
    """Distance from a transmitter over the target to each receiver, m (as in the docs)."""

    name: str = "bistatic"
    transmitter: tuple[float, ...]
    receivers: tuple[tuple[float, ...], ...]

    def default_channels(self) -> tuple[str, ...]:
        return tuple(f"{self.name}_{i + 1}" for i in range(len(self.receivers)))

    def measure(self, position: Tensor, inputs: object, constants: object) -> tuple[Tensor, Tensor]:
        out = position - position.new_tensor(self.transmitter)
        back = position.unsqueeze(-2) - position.new_tensor(self.receivers)
        there = torch.linalg.vector_norm(out, dim=-1, keepdim=True)
        home = torch.linalg.vector_norm(back, dim=-1)
        gradient = (out / there).unsqueeze(-2) + back / home.unsqueeze(-1)
        return there + home, gradient


def test_the_bistatic_radar_of_the_documentation() -> None:
    radar = Bistatic(transmitter=(0.0, 0.0), receivers=((500.0, 0.0), (0.0, 500.0)), sigma=5.0)
    assert_engines_agree(Filter(ConstantVelocity(), (radar,), tanh))


def refused(function: Callable[[Tensor], Tensor]) -> Filter:
    sensor = FunctionSensor(("r",), lambda s, i, v: function(s[..., :1]), sigma=1.0)
    return Filter(ConstantVelocity(), (sensor,))


@pytest.mark.parametrize(
    ("function", "message"),
    [
        (lambda x: torch.lgamma(x.square() + 1.0), "no rule for lgamma, used at .*own_models.py"),
        (lambda x: x.float().exp().double(), "conversion to torch.float32, .*own_models.py"),
    ],
)
def test_what_has_no_rule_is_named_and_torch_runs_after_one_warning(
    function: Callable[[Tensor], Tensor], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("DIFFFILTER_ENGINE", raising=False)
    filter = refused(function)
    log = log_of(filter, 600)
    with pytest.raises(EngineError, match=message):
        run(filter, log, engine="fused")
    notice._told.clear()
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        tracks = [run(filter, log), run(filter, log)]
    assert len([w for w in told if "torch runs instead" in str(w.message)]) == 1
    assert math.isfinite(float(tracks[1].mean.sum()))


def test_many_iterations_are_refused_at_once_and_run_by_torch(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delenv("DIFFFILTER_ENGINE", raising=False)
    sensor = FunctionSensor(("r",), lambda s, i, v: s[..., :1], sigma=1.0)
    filter = Filter(ConstantVelocity(), (sensor,), tanh, iterations=300)
    log = log_of(filter, 2)
    with pytest.raises(EngineError, match="found 300 iterations, expected 64 or fewer"):
        run(filter, log, engine="fused")
    notice._told.clear()
    with pytest.warns(UserWarning, match="300 iterations.*torch runs instead"):
        chosen = settled("auto", lambda: run(filter, log, engine="fused"), math.inf)
    assert chosen == "torch"


def test_a_step_that_is_too_large_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(program, "LARGEST", 50)
    sensor = FunctionSensor(("r",), lambda s, i, v: s[..., :1].cosh(), sigma=1.0)
    filter = Filter(ConstantVelocity(), (sensor,))
    with pytest.raises(EngineError, match="more than 50 operations"):
        run(filter, log_of(filter), engine="fused")


@pytest.mark.parametrize("trajectories", [1, 2, 3, 9])
def test_lanes_by_job_give_the_same_numbers(trajectories: int) -> None:
    sensor = FunctionSensor(("r",), lambda s, i, v: s[..., :1], sigma=1.0)
    filter = Filter(ConstantVelocity(), (sensor,))
    single = log_of(filter)
    z = single.z[:, None, :] + torch.arange(trajectories, dtype=D)[:, None]
    log = Log(filter.channels, single.time, z, start=single.start)
    slow, fast = (run(filter, log, engine=engine) for engine in ("torch", "fused"))
    torch.testing.assert_close(fast.mean, slow.mean, rtol=1e-12, atol=1e-12)
    assert width_for(trajectories) == {1: 1, 2: 2, 3: 4, 9: 8}[trajectories]


def test_a_belief_that_was_read_stays_as_it_was() -> None:
    sensor = FunctionSensor(("r",), lambda s, i, v: s[..., :1], sigma=1.0)
    filter = Filter(ConstantVelocity(), (sensor,))
    tracker = Tracker(filter, [0.0] * 4, torch.eye(4, dtype=D), engine="fused")
    tracker.step([1.0], dt=1.0)
    read = tracker.belief
    kept = read.mean.clone(), read.deviations.clone()
    tracker.step([5.0], dt=1.0)
    assert torch.equal(read.mean, kept[0])
    assert torch.equal(read.deviations, kept[1])
    assert not torch.equal(tracker.belief.mean, kept[0])


def test_the_choice_is_the_same_for_the_same_job(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DIFFFILTER_ENGINE", raising=False)
    sensor = FunctionSensor(("r",), lambda s, i, v: s[..., :1], sigma=1.0)
    filter = Filter(ConstantVelocity(), (sensor,))

    def chosen(rows: int, trajectories: int) -> str:
        z = torch.zeros(rows, trajectories, 1, dtype=D)
        log = Log(filter.channels, torch.arange(rows, dtype=D), z)
        return pick("auto", eager_seconds(log))

    assert chosen(100, 256) == "auto"  # to be compiled
    assert chosen(20, 1) == "torch"


@pytest.mark.parametrize("engine", ["torch", "fused"])
def test_fed_rows_are_the_same_as_steps(engine: str) -> None:
    sensor = FunctionSensor(("r",), lambda s, i, v: s[..., :1], sigma=1.0)
    filter = Filter(ConstantVelocity(), (sensor,))
    one, many = (Tracker(filter, [0.0] * 4, torch.eye(4, dtype=D), engine=engine) for _ in "ab")
    z = torch.linspace(0.0, 3.0, 8, dtype=D)[:, None]
    z[3] = torch.nan
    dt = torch.linspace(0.5, 1.5, 8, dtype=D)
    records = [one.step(row, dt=float(d)) for row, d in zip(z, dt, strict=True)]
    track = torch.cat([many.feed(z[:5], dt[:5]).mean, many.feed(z[5:], dt[5:]).mean])
    torch.testing.assert_close(many.belief.mean, one.belief.mean, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(track[-1], one.belief.mean, rtol=1e-12, atol=1e-12)
    assert (many.steps, len(records)) == (8, 8)
    before = many.belief.mean
    with pytest.raises(InputError, match="dt: found less than 0"):
        many.feed(z, -dt)
    with pytest.raises(InputError, match="log: found 2 columns"):
        many.feed(torch.zeros(3, 2, dtype=D), dt[:3])
    assert torch.equal(many.belief.mean, before)


def test_a_whole_number_times_what_a_constant_multiplies_is_that_number() -> None:
    """Under forward differentiation torch hands plain numbers over as if they were tensors."""
    up = torch.tensor([0.0, 0.0, 9.81], dtype=D)

    def tilt(s: Tensor, inputs: object, values: object) -> Tensor:
        return (2 * (s[..., 0] * up[2] - s[..., 1] * up[0])).unsqueeze(-1)

    sensor = FunctionSensor(("t",), tilt, sigma=1.0)
    assert_engines_agree(Filter(ConstantVelocity(), (sensor,)))
