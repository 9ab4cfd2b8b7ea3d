"""Gauss-Newton, L-BFGS and Adam: each lowers the loss, resumes to the same bits, keeps its word."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from resume_cases import Run, kill_after, same
from tune_cases import FEW, airport, recorded

from difffilter.engine.build import compiler
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter, ParameterSet
from difffilter.scenario.scenario import load_scenario
from difffilter.scenario.settings import TuneSettings
from difffilter.tuning.curvature import Expansion
from difffilter.tuning.loop import TuneResult, tune
from difffilter.tuning.optimisers import GaussNewton

pytestmark = [
    pytest.mark.skipif(compiler() is None, reason="no C compiler"),
    pytest.mark.usefixtures("quick_compiler"),
]

SETTINGS = FEW | {"system": "ekf", "evaluate_every": 5, "test": 2}
BAD = {"parameters__tdoa__sigma__value": 60.0, "faults__nlos__probability": 0.0}


def tuned(optimiser: str, engine: str = "fused", **settings: Any) -> TuneResult:
    """From a sigma that is far too large."""
    chosen = SETTINGS | {"optimiser": optimiser} | settings
    return tune(airport(**BAD), seed=1, settings=chosen, engine=engine)


@pytest.mark.parametrize(
    ("optimiser", "rate"), [("gauss-newton", 0.1), ("lbfgs", 0.1), ("adam", 0.3)]
)
def test_every_optimiser_lowers_the_loss(optimiser: str, rate: float) -> None:
    loss = {"position": 1.0, "consistency": 0.5}
    training = tuned(optimiser, learning_rate=rate, loss=loss, steps=8).checkpoint.training
    assert training["validation_loss"] < training["validation_loss_published"] - 0.05


def test_gauss_newton_takes_the_same_way_with_either_engine() -> None:
    loss = {"position": 1.0, "consistency": 0.5}
    fast, slow = (tuned("gauss-newton", e, steps=3, loss=loss) for e in ("fused", "torch"))
    assert len(fast.history) == len(slow.history) == 4
    for a, b in zip(fast.history, slow.history, strict=True):
        assert a.validation == pytest.approx(b.validation, rel=1e-9)
        assert a.training == pytest.approx(b.training, rel=1e-9, nan_ok=True)
        for name, value in b.values.items():
            assert a.values[name] == pytest.approx(value, rel=1e-9, abs=1e-12), name


#: What auto takes: Gauss-Newton validates every step where Adam does every fifth.
CHOSEN = [
    ({"position": 1.0}, "gauss-newton"),
    ({"position": 1.0, "consistency": 0.3, "innovation-consistency": 0.1}, "gauss-newton"),
    ({"likelihood": 1.0}, "adam"),
    ({"position": 1.0, "likelihood": 0.1}, "adam"),
    ({"consistency": 1.0}, "adam"),
]


@pytest.mark.parametrize(("loss", "expected"), CHOSEN)
def test_auto_takes_gauss_newton_for_squared_errors_only(
    loss: dict[str, float], expected: str
) -> None:
    found, named = (tuned(name, loss=loss, steps=2) for name in ("auto", expected))
    assert repr(found.history) == repr(named.history)
    steps = [entry.step for entry in found.history]
    assert steps == ([0, 1, 2] if expected == "gauss-newton" else [0, 2])


def on_trajectories(optimiser: str, tmp_path: Path) -> Run:
    def run(**options: Any) -> TuneResult:
        chosen = SETTINGS | {"optimiser": optimiser, "steps": 11, "patience": 40}
        return tune(airport(**BAD), seed=1, settings=chosen, engine="fused", **options)

    return run


def on_windows(optimiser: str, tmp_path: Path) -> Run:
    scenario, log = load_scenario("uwb-ranges"), recorded(tmp_path)
    chosen = {"steps": 11, "evaluate_every": 5, "patience": 40, "window": 9,
              "refresh": 3, "optimiser": optimiser}  # fmt: skip

    def run(**options: Any) -> TuneResult:
        return tune(
            scenario, log, seed=1, validation=log, settings=chosen, engine="fused", **options
        )

    return run


@pytest.mark.parametrize("after", [10])
@pytest.mark.parametrize("make", [on_trajectories, on_windows])
@pytest.mark.parametrize("optimiser", ["gauss-newton", "lbfgs"])
def test_a_killed_run_resumes_to_the_same_bits(
    tmp_path: Path, optimiser: str, make: Callable[[str, Path], Run], after: int
) -> None:
    """Killed after it has cooled down: what the optimiser has learnt counts on."""
    run, out = make(optimiser, tmp_path), tmp_path / "x.json"
    expected = run()
    with pytest.MonkeyPatch.context() as patch:
        kill_after(patch, after)
        with pytest.raises(KeyboardInterrupt):
            run(out=out)
    same(run(out=out, resume=True), expected)


def expansion(loss: float, gradient: list[float]) -> Expansion:
    """A loss whose curvature is 1 in both directions."""
    p = len(gradient)
    known = {"loss": loss, "terms": {}, "gradient": torch.tensor(gradient, dtype=torch.float64)}
    square = torch.eye(p).double()
    return Expansion(**{name: known.get(name, square) for name in Expansion._fields})


@pytest.fixture
def pair() -> ParameterSet:
    return ParameterSet(
        {name: Parameter(name, v, Positive(), tuned=True) for name, v in (("a", 0.3), ("b", 7.1))}
    )


@pytest.mark.parametrize("worse", [1.0, float("nan"), float("inf")])
def test_a_step_that_does_not_lower_the_loss_leaves_the_values_as_they_were(
    pair: ParameterSet, worse: float
) -> None:
    optimiser = GaussNewton(TuneSettings(), pair)
    before = [x.detach().clone() for x in optimiser.free]
    tried: list[list[float]] = []

    def expand(temperature: float) -> Expansion:
        here = [x.item() for x in optimiser.free]
        tried.append(here)
        same_place = all(abs(x - y.item()) < 1e-9 for x, y in zip(here, before, strict=True))
        return expansion(0.5 if same_place else 0.5 + worse, [0.37, -0.21])

    for step in range(9, 13):
        damping = optimiser.damping
        optimiser.step(step, lambda t: pytest.fail("no batch"), expand, False)  # type: ignore[arg-type, return-value]
        assert optimiser.damping > damping
        for x, y in zip(optimiser.free, before, strict=True):
            assert torch.equal(x, y)
    sizes = [sum((a - b.item()) ** 2 for a, b in zip(t, before, strict=True)) for t in tried[1:]]
    assert sizes == sorted(sizes, reverse=True)  # ever shorter
    assert sizes[-1] < sizes[0]


def test_no_step_is_longer_than_a_unit(pair: ParameterSet) -> None:
    optimiser = GaussNewton(TuneSettings(), pair)
    before = [x.item() for x in optimiser.free]
    losses = iter([5.0, 1.0])
    optimiser.step(
        9, lambda t: pytest.fail("no batch"), lambda t: expansion(next(losses), [40.0, 0.1]), False  # type: ignore[arg-type, return-value]
    )  # fmt: skip
    moved = [abs(x.item() - y) for x, y in zip(optimiser.free, before, strict=True)]
    assert 0.1 < max(moved) <= 1.0
