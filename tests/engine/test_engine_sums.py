"""Sums of losses with tangents: both engines, any batch, any number of threads, every refusal."""

from __future__ import annotations

import os
import subprocess
import sys
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from engine_cases import LOSSES, SCENES, irregular, leaves, short_log, with_reference
from helpers import assert_close, tensor
from sums_cases import plane, summed

from difffilter import Filter, Log, Start, load_scenario, simulate, started
from difffilter.engine import choice, notice
from difffilter.engine.build import compiler
from difffilter.errors import EngineError, InputError, NonFiniteError
from difffilter.filters.recipe import Recipe
from difffilter.motions.blocks import FunctionMotion
from difffilter.running.batch import prepared, run
from difffilter.running.objectives import Problem, Sums, objective, sum_losses
from difffilter.sensors.sensor import FunctionSensor

pytestmark = [
    pytest.mark.skipif(compiler() is None, reason="no C compiler"),
    pytest.mark.usefixtures("quick_compiler"),
]


def assert_same_sums(found: Sums, expected: Sums) -> None:
    assert found.sizes == expected.sizes
    assert_close(found.values, expected.values, 1e-9)
    for got, wanted in ((found.tangents, expected.tangents), (found.gram, expected.gram)):
        assert got.shape == wanted.shape
        # Each direction has a unit of its own.
        least = 1e-11 * float(wanted.abs().max())
        for direction in range(got.shape[1]):
            a, b = got[:, direction], wanted[:, direction]
            assert float((a - b).abs().max()) <= 1e-7 * float(b.abs().max()) + least


@pytest.mark.parametrize(
    ("name", "system"),
    [
        ("airport-mlat-intermittent", "adaptive-ekf"),  # the adaptation has a memory
        ("gate-lockout", "gated-inflate"),  # so has recovery
        ("manoeuvre-fusion-2", "stf-srckf"),
    ],
)
def test_both_engines_give_the_same_sums_tangents_and_gram(name: str, system: str) -> None:
    filter, log = short_log(name, system)
    assert_same_sums(summed(filter, log, "fused"), summed(filter, log, "torch"))


def test_both_engines_give_the_same_sums_for_a_log_of_one_trajectory() -> None:
    filter, log = plane(1)
    assert log.truth is not None
    assert log.start is not None
    one = replace(
        log, z=log.z[:, 0], truth=log.truth[:, 0], start=Start(log.start.mean[0]),
        time=log.time if log.time.dim() == 1 else log.time[:, 0],
    )  # fmt: skip
    alone = summed(filter, one, "fused")
    assert_same_sums(alone, summed(filter, one, "torch"))
    assert_same_sums(alone, summed(filter, log, "fused"))


def test_both_engines_give_the_same_sums_for_scenes() -> None:
    filter, log = plane(3)
    log = with_reference(filter, log)
    losses = {"scenes": 1.0, "position": 0.5}
    fast, slow = (summed(filter, log, e, losses, SCENES) for e in ("fused", "torch"))
    assert fast.sizes == {"scenes": 6, "position": 2}
    assert_same_sums(fast, slow)


def test_a_tuned_start_has_tangents() -> None:
    """start.sigma moves the belief at the start, and nothing else."""
    filter, log = plane(3)
    fast, slow = (summed(filter, log, engine) for engine in ("fused", "torch"))
    names = list(filter.published())
    at = sum(filter.published()[n].numel() for n in names[: names.index("start.sigma")])
    assert float(slow.tangents[:, at].abs().max()) > 1e-3
    assert_close(fast.tangents[:, at], slow.tangents[:, at], 1e-8)


def test_the_memory_that_a_start_brings_is_used() -> None:
    """Windows start from a belief with the adaptation's memory."""
    filter, log = short_log("manoeuvre-fusion-2", "stf-srckf")
    whole = run(filter, log.rows(0, 6), None, log.start, engine="torch").final
    assert whole is not None
    assert whole.memory
    fresh = whole._replace(memory={})
    rest = log.rows(6, 14)
    found = [
        sum_losses(Problem(filter, rest, LOSSES, start=start, engine=engine), leaves(filter))
        for start in (whole, fresh)
        for engine in ("fused", "torch")
    ]
    assert_same_sums(found[0], found[1])
    assert_same_sums(found[2], found[3])
    assert not torch.allclose(found[0].values, found[2].values, rtol=1e-6)


@pytest.mark.parametrize("index", [[0], [8], [0, 1, 2, 3, 4, 5, 6], [7, 2, 8], list(range(8))])
def test_a_trajectorys_sums_do_not_depend_on_its_neighbours(index: list[int]) -> None:
    filter, log = plane(9)
    whole = summed(filter, log, "fused")
    part = summed(filter, log.select(index), "fused")
    assert torch.equal(part.values, whole.values[index])
    # One trajectory alone runs one lane wide, where the compiler joins other operations.
    close = {"rtol": 1e-13, "atol": 1e-13} if len(index) == 1 else {"rtol": 0.0, "atol": 0.0}
    assert torch.allclose(part.tangents, whole.tangents[index], **close)
    assert torch.allclose(part.gram, whole.gram[index], **close)


THREADS = """
import sys, torch
sys.path.insert(0, sys.argv[1])
from sums_cases import plane, summed
filter, log = plane(37)
found = summed(filter, log, "fused")
for part in (found.values, found.tangents, found.gram):
    print(part.detach().numpy().tobytes().hex())
"""


def test_one_thread_and_two_give_the_same_bits() -> None:
    found = []
    for threads in ("1", "2"):
        done = subprocess.run(
            [sys.executable, "-c", THREADS, str(Path(__file__).parents[1])],
            env=os.environ | {"OMP_NUM_THREADS": threads},
            capture_output=True,
            timeout=100,
        )
        assert done.returncode == 0, done.stderr.decode()
        found.append(done.stdout)
    assert found[0] == found[1] != b""


def test_without_gradient_there_are_no_tangents() -> None:
    filter, log = plane(3)
    with torch.no_grad():
        found = summed(filter, log, "fused")
    assert found.tangents.shape == (3, 0, found.values.shape[1])
    assert not found.values.requires_grad
    assert_close(found.values, summed(filter, log, "torch").values, 1e-9)


def test_the_sums_carry_their_gradient_into_autograd() -> None:
    filter, log = plane(3)
    values = leaves(filter)
    found = sum_losses(Problem(filter, log, LOSSES, temperature=0.3, engine="fused"), values)
    (gradient,) = torch.autograd.grad(found.values[1, 0], values["motion.acceleration"])
    at = list(values).index("motion.acceleration")
    assert float(gradient) == pytest.approx(float(found.tangents[1, at, 0]), rel=1e-12)


@pytest.mark.parametrize("gradient", [False, True])
def test_a_value_that_is_not_finite_is_named_as_by_torch(gradient: bool) -> None:
    """All states fall by one a step; trajectory 1 leaves the model's domain at step 2."""
    sensor = FunctionSensor(("r",), lambda x, i, v: (x[..., :1] - 2.0).log(), 1e4)
    motion = FunctionMotion(
        ("x",),
        lambda x, dt, i, v: x - 1.0,
        lambda dt, v: 0.1 * torch.ones_like(dt)[..., None, None],
    )
    filter = Filter(motion, (sensor,))
    start = Start(tensor([[9.0], [4.5], [8.0]]), torch.eye(1).double().expand(3, 1, 1).clone())
    z = torch.zeros(4, 3, 1).double()
    log = Log(("r",), torch.arange(4).double(), z, start=start)
    values = leaves(filter) if gradient else filter.published()
    errors = []
    for engine in ("torch", "fused"):
        with pytest.raises(NonFiniteError) as caught:
            objective(Problem(filter, log, {"likelihood": 1.0}, engine=engine), values)
        errors.append(caught.value)
    assert str(errors[0]) == str(errors[1])
    assert (errors[1].trajectory, errors[1].step) == (1, 2)


@pytest.fixture
def auto(monkeypatch: pytest.MonkeyPatch) -> None:
    """auto tries the compiled engine, however short the job, and nothing has been told."""
    monkeypatch.setenv("DIFFFILTER_ENGINE", "auto")
    monkeypatch.setattr(choice, "ENOUGH", 0.0)
    monkeypatch.setattr(notice, "_told", set())


def value(filter: Filter, log: Log, engine: str) -> float:
    values = filter.published(log.z.dtype)
    return float(objective(Problem(filter, log, {"likelihood": 1.0}, engine=engine), values)[0])


def warned(filter: Filter, log: Log) -> list[str]:
    """What three runs by auto warn; each gives what torch gives."""
    expected = value(filter, log, "torch")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for _ in range(3):
            assert value(filter, log, "auto") == expected
    return [str(w.message) for w in caught]


@pytest.mark.usefixtures("auto")
def test_single_precision_is_refused_and_auto_says_so_once() -> None:
    filter, log = plane(3)
    single = log.to(torch.float32)
    with pytest.raises(EngineError) as caught:
        value(filter, single, "fused")
    assert str(caught.value) == "engine fused: found torch.float32, expected float64"
    assert warned(filter, single) == [f"{caught.value}; torch runs instead, slower"]


@pytest.mark.usefixtures("auto")
def test_an_operation_without_a_rule_is_named_and_auto_says_so_once() -> None:
    def h(x: torch.Tensor, inputs: object, values: object) -> torch.Tensor:
        return torch.lgamma(x[..., :1])  # the line that the message names

    line = h.__code__.co_firstlineno + 1
    motion = FunctionMotion(("x",), lambda x, dt, i, v: x, lambda dt, v: dt[..., None, None])
    filter = Filter(motion, (FunctionSensor(("r",), h),))
    start = Start(tensor([0.5]), torch.eye(1).double())
    log = Log(("r",), torch.arange(3).double(), torch.ones(3, 1).double(), start=start)
    with pytest.raises(EngineError, match="no rule for lgamma") as caught:
        value(filter, log, "fused")
    assert f"test_engine_sums.py:{line}" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert warned(filter, log) == [f"{caught.value}; torch runs instead, slower"]


@pytest.mark.usefixtures("auto")
def test_auto_runs_the_compiled_engine_where_it_can() -> None:
    filter, log = plane(3)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert value(filter, log, "auto") == value(filter, log, "fused")
    assert value(filter, log, "auto") != value(filter, log, "torch")  # other roundings


def test_a_short_job_is_left_to_torch(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DIFFFILTER_ENGINE", "auto")
    if choice.compiler() is not None:
        assert choice.pick("auto", 0.5 * choice.ENOUGH) == "torch"
        assert choice.pick("auto", 2.0 * choice.ENOUGH) == "auto"
    monkeypatch.setenv("DIFFFILTER_ENGINE", "fused")
    assert choice.pick("auto", 0.0) == "fused"
    assert choice.pick("torch", 1e9) == "torch"
    monkeypatch.setenv("DIFFFILTER_ENGINE", "gpu")
    with pytest.raises(InputError, match="engine: found 'gpu', expected one of"):
        choice.pick("auto", 1.0)


def test_a_start_with_a_covariance_of_its_own_has_no_tangents() -> None:
    """start.sigma then moves nothing."""
    filter, log = plane(3)
    assert log.start is not None
    given = replace(log.start, covariance=torch.eye(4).double().expand(3, 4, 4))
    found = summed(filter, replace(log, start=given), "fused")
    at = list(filter.published()).index("start.sigma")
    count = sum(v.numel() for v in list(filter.published().values())[:at])
    assert float(found.tangents[:, count].abs().max()) == 0.0
    assert float(found.tangents.abs().max()) > 0.0
    _, current, _ = prepared(filter, replace(log, start=given))
    assert not current.deviations.requires_grad


def test_full_optimisation_gives_the_same_sums(monkeypatch: pytest.MonkeyPatch) -> None:
    """As it is compiled for everyone, vector code included; the others here are not."""
    scenario = load_scenario("gate-lockout")
    filter = scenario.system("gated")
    assert isinstance(filter, Recipe)
    log = started(scenario, filter, simulate(scenario, 9, seed=2))
    log = irregular(replace(log.rows(0, 25), start=log.start))
    monkeypatch.undo()  # quick_compiler
    assert_same_sums(summed(filter, log, "fused"), summed(filter, log, "torch"))
