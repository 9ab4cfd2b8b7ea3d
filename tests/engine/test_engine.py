"""The fused engine gives what the torch step gives, for every kind of filter."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from helpers import tensor
from torch import Tensor

from difffilter import Filter, Log, Range, Start, load_scenario, run, simulate, started
from difffilter.engine import build as builder
from difffilter.engine.build import compiler
from difffilter.engine.program import Program
from difffilter.errors import InputError, NonFiniteError
from difffilter.filters.recipe import Recipe
from difffilter.motions.blocks import FunctionMotion
from difffilter.sensors.position import Position
from difffilter.sensors.sensor import FunctionSensor
from difffilter.weights.registry import huber

pytestmark = pytest.mark.skipif(compiler() is None, reason="no C compiler")

#: One system of each kind.
SYSTEMS = [
    ("airborne-bearing", "gated", {}),
    ("airborne-bearing-absolute", "robust-noise", {}),
    ("airborne-bearing-multipath", "clairvoyant", {}),
    ("airport-mlat-intermittent", "adaptive-ekf", {}),
    ("airport-mlat-intermittent", "m-ekf-all-rows", {}),
    ("airport-mlat-intermittent", "ekf", {"systems.ekf.common_noise": True}),
    ("airport-mlat-intermittent", "ekf", {"systems.ekf.scope": "sensor",
                                          "systems.ekf.gate": "inflate",
                                          "systems.ekf.weight": "barron"}),
    ("gate-lockout", "gated-inflate", {}),
    ("gate-lockout", "gated-widen", {}),
    ("manoeuvre-fusion-2", "rmckf", {}),
    ("manoeuvre-fusion-2", "stf-srckf", {}),
    ("manoeuvre-fusion-2", "pooled-robust", {}),
    ("manoeuvre-fusion-2", "fusion", {}),
    ("urban-credibility-2d", "credibility", {}),
    ("urban-credibility-faulty", "ideal", {}),
]  # fmt: skip


def assert_same(system: Filter, log: Log, temperature: float | None = None) -> None:
    """Means to 1e-9, covariances and records to 1e-7, relative to the largest entry."""
    slow = run(system, log, temperature=temperature)
    fast = run(system, log, temperature=temperature, engine="fused")
    pairs: list[tuple[str, Tensor, Tensor, float]] = [
        ("mean", fast.mean, slow.mean, 1e-9),
        ("covariance", fast.covariance, slow.covariance, 1e-7),
    ]
    assert fast.record is not None
    assert slow.record is not None
    for name in slow.record._fields:
        pairs.append((name, getattr(fast.record, name), getattr(slow.record, name), 1e-7))
    assert fast.final is not None
    assert slow.final is not None
    for name, value in slow.final.memory.items():
        pairs.append((name, fast.final.memory[name], value, 1e-7))
    for name, got, expected, tolerance in pairs:
        assert got.dtype == expected.dtype, name
        assert got.shape == expected.shape, name
        a, b = (np.nan_to_num(x.double().numpy()) for x in (got, expected))
        np.testing.assert_allclose(
            a, b, 0.0, tolerance * max(1.0, np.abs(b).max(initial=0.0)), err_msg=name
        )


def shortened(name: str, system: str, overrides: dict[str, object]) -> tuple[Filter, Log]:
    """A system and a log of its first 60 rows with gaps, five trajectories."""
    scenario = load_scenario(name, overrides)
    chosen = scenario.system(system)
    assert isinstance(chosen, Recipe)
    log = started(scenario, chosen, simulate(scenario, 5, seed=3))
    short = log.rows(0, 60)
    missing = torch.rand(short.z.shape, generator=torch.Generator().manual_seed(1)) < 0.1
    return chosen, replace(short, z=torch.where(missing, torch.nan, short.z), start=log.start)


@pytest.mark.parametrize(("name", "system", "overrides"), SYSTEMS)
def test_both_engines_give_the_same_estimates_records_and_memory(
    name: str, system: str, overrides: dict[str, object]
) -> None:
    assert_same(*shortened(name, system, overrides))


@pytest.mark.parametrize(
    ("name", "system"),
    [("airborne-bearing", "gated"), ("airport-mlat-intermittent", "m-ekf"),
     ("manoeuvre-fusion-2", "fusion")],
)  # fmt: skip
def test_the_soft_forms_are_the_same_too(name: str, system: str) -> None:
    chosen, log = shortened(name, system, {})
    assert_same(chosen, log, temperature=0.3)


def test_irregular_times_and_a_single_trajectory() -> None:
    chosen, log = shortened("airport-mlat-intermittent", "ekf", {})
    time = torch.rand(60, generator=torch.Generator().manual_seed(2), dtype=torch.float64).cumsum(0)
    assert log.start is not None
    start = Start(log.start.mean[0], torch.eye(4, dtype=torch.float64), 0.0)
    assert_same(chosen, replace(log, time=time, start=replace(log.start, time=0.0)))
    assert_same(chosen, Log(log.channels, time, log.z[:, 0], start=start))


def test_a_users_own_model_goes_through() -> None:
    def f(x: Tensor, dt: Tensor, inputs: object, values: object) -> Tensor:
        return torch.stack([x[..., 0] + dt * x[..., 1].sin(), 0.9 * x[..., 1]], dim=-1)

    motion = FunctionMotion(
        ("x", "vx"), f, lambda dt, v: torch.diag_embed(dt[..., None].expand(*dt.shape, 2) * 0.1)
    )
    sensor = FunctionSensor(("r",), lambda x, i, v: (x[..., :1].square() + 1.0).sqrt())
    z = tensor(np.linspace(1.0, 3.0, 20))[:, None]
    start = Start(tensor([1.0, 0.1]), torch.eye(2, dtype=torch.float64))
    for rule in ("taylor", "cubature"):
        assert_same(
            Filter(motion, (sensor,), huber, linearise=rule),
            Log(("r",), torch.arange(20).double(), z, start=start),
        )


def test_an_operation_without_a_rule_is_named_with_its_place() -> None:
    sensor = FunctionSensor(("r",), lambda x, i, v: torch.lgamma(x[..., :1]))
    motion = FunctionMotion(("x",), lambda x, dt, i, v: x, lambda dt, v: dt[..., None, None])
    log = Log(("r",), torch.arange(3).double(), torch.ones(3, 1).double())
    start = Start(tensor([0.5]), torch.eye(1, dtype=torch.float64))
    with pytest.raises(InputError, match="engine: no rule for lgamma"):
        run(Filter(motion, (sensor,)), log, start=start, engine="fused")


def test_a_value_that_is_not_finite_is_named_by_trajectory_step_and_channel() -> None:
    sensor = FunctionSensor(("r",), lambda x, i, v: (x[..., :1] - 2.0).log())
    motion = FunctionMotion(("x",), lambda x, dt, i, v: x, lambda dt, v: dt[..., None, None])
    z = torch.zeros(4, 3, 1).double()
    start = Start(tensor([[5.0], [1.0], [4.0]]), torch.eye(1, dtype=torch.float64).expand(3, 1, 1))
    log = Log(("r",), torch.arange(4).double(), z, start=start)
    with pytest.raises(NonFiniteError, match=r"trajectory 1.*step 0.*r"):
        run(Filter(motion, (sensor,)), log, engine="fused")


def test_what_the_engine_cannot_do_is_an_error() -> None:
    chosen, log = shortened("gate-lockout", "ekf", {})
    with pytest.raises(InputError, match="engine: found 'gpu', expected one of auto, torch, fused"):
        run(chosen, log, engine="gpu")
    single = {name: value.float() for name, value in chosen.published().items()}
    with pytest.raises(InputError, match=r"found torch\.float32, expected float64"):
        run(chosen, log.to(torch.float32), single, engine="fused")
    values = {name: value.requires_grad_() for name, value in chosen.published().items()}
    with pytest.raises(InputError, match="found values with gradient"):
        run(chosen, log, values, engine="fused")


def test_without_a_compiler_the_message_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(builder, "compiler", lambda: None)
    with pytest.raises(InputError, match="found no C compiler, expected cc or gcc"):
        builder.build("int never_compiled_before;")


def test_a_compiler_that_fails_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match=r"engine: .* failed"):
        builder.build("this is not C")


def test_two_processes_share_the_cache_and_leave_no_half_written_file(tmp_path: Path) -> None:
    code = (
        "import torch, difffilter as df; s = df.load_scenario('gate-lockout', {'world.steps': 80});"
        "f = s.system('ekf'); l = df.started(s, f, df.simulate(s, 2));"
        "print(float(df.run(f, l, engine='fused').mean.sum()))"
    )
    env = {**os.environ, "DIFFFILTER_CACHE": str(tmp_path)}
    jobs = [
        subprocess.Popen([sys.executable, "-c", code], env=env, stdout=subprocess.PIPE)
        for _ in range(2)
    ]
    outputs = [job.communicate()[0] for job in jobs]
    assert outputs[0] == outputs[1] != b""
    # Libraries, their digests, and what the trace was told; nothing half-written.
    assert {path.suffix for path in tmp_path.iterdir()} == {".so", ".sha256", ".json"}


def test_a_program_folds_constants_and_shares_expressions() -> None:
    program = Program()
    x, one, zero = program.input("s", 0), program.const(1.0), program.const(0.0)
    assert program.make("mul", x, one) == x
    assert program.value(program.make("mul", x, zero)) == 0.0
    assert program.make("add", x, one) == program.make("add", one, x)
    assert program.value(program.make("sqrt", program.const(9.0))) == 3.0
    assert program.make("select", one, x, zero) == x
    assert program.make("neg", program.make("neg", x)) == x


def test_a_filter_of_two_sensors_of_other_kinds() -> None:
    stations = [(0.0, 0.0), (50.0, 0.0), (0.0, 40.0)]
    from difffilter.motions.blocks import ConstantVelocity

    mixed = Filter(
        ConstantVelocity(2),
        (Range(stations=stations, sigma=0.5), Position(sigma=2.0)),
        huber,
        federated=True,
    )
    z = torch.full((12, 2, 5), 20.0, dtype=torch.float64)
    z[3, :, 1] = torch.nan
    start = Start(tensor([[10.0, 10.0, 0.0, 0.0]] * 2), torch.eye(4).double().expand(2, 4, 4))
    assert_same(mixed, Log(mixed.channels, torch.arange(12).double(), z, start=start))


def test_the_command_line_compares_and_runs_with_it(tmp_path: Path) -> None:
    def command(*arguments: str) -> bytes:
        line = [sys.executable, "-m", "difffilter", *arguments]
        return subprocess.run(line, cwd=tmp_path, capture_output=True, check=True).stdout

    both = ["compare", "gate-lockout", "--trajectories", "4", "--system", "gated", "--json"]
    slow, fast = (json.loads(command(*both, "--engine", e)) for e in ("torch", "fused"))
    assert fast["rows"][0]["rmse"] == pytest.approx(slow["rows"][0]["rmse"], rel=1e-9)
    command("simulate", "gate-lockout", "--trajectories", "1", "--seed", "3", "--out", "logs")
    (log,) = (tmp_path / "logs").iterdir()
    found = command(
        "run", "gate-lockout", str(log), "--out", "e.csv", "--engine", "fused", "--json"
    )
    assert json.loads(found)["rows"] == 150
