"""How well data determine tuned values, in a linear world where that is known."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import pytest
import torch

from difffilter import Filter, Log, Start
from difffilter.engine.build import compiler
from difffilter.motions.blocks import FunctionMotion
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter, ParameterSet
from difffilter.running.objectives import Problem, sum_losses
from difffilter.scenario.settings import TuneSettings
from difffilter.sensors.sensor import FunctionSensor
from difffilter.tuning.curvature import Expansion, expand
from difffilter.tuning.optimisers import GaussNewton
from difffilter.tuning.standard_errors import Certainty, certainty

pytestmark = [
    pytest.mark.skipif(compiler() is None, reason="no C compiler"),
    pytest.mark.usefixtures("quick_compiler"),
]

Q, R = "walk.q", "seen.sigma"
POSITION = {"position": 1.0}
BOTH = {"position": 1.0, "consistency": 1.0}


def walk() -> Filter:
    """A random walk that is seen with noise: a Kalman filter of two numbers."""
    q = Parameter(Q, 0.7, Positive(), "m", "true", tuned=True)
    motion = FunctionMotion(
        ("x",),
        lambda x, dt, i, v: x,
        lambda dt, v: (dt.sqrt() * v[Q])[..., None, None],
        parameters=(q,),
    )
    sensor = FunctionSensor(("z",), lambda x, i, v: x[..., :1], 1.0, name="seen")
    filter = Filter(motion, (sensor,))
    return replace(filter, overrides={R: replace(filter.declarations[R], tuned=True)})


def simulated(seed: int, batch: int = 24, steps: int = 25, q: float = 0.7) -> Log:
    """Trajectories of that world; the start is as uncertain as the filter believes."""
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(3, steps + 1, batch, 1, generator=generator, dtype=torch.float64)
    x = (noise[0, :1] + q * torch.cat([torch.zeros(1, batch, 1), noise[1, 1:]]).cumsum(0))[1:]
    start = Start(torch.zeros(batch, 1).double(), torch.eye(1).double().expand(batch, 1, 1), 0.0)
    time = torch.arange(1, steps + 1).double()
    return Log(("z",), time, x + noise[2, 1:], x, ("x",), start=start)


FILTER = walk()


def expanded(
    parameters: ParameterSet, log: Log, losses: dict[str, float], temperature: float = 0.0
) -> Expansion:
    sums = sum_losses(Problem(FILTER, log, losses, engine="fused"), parameters.values())
    return expand(losses, sums, parameters, 0.0)


def optimum(log: Log, losses: dict[str, float], steps: int = 14) -> ParameterSet:
    parameters = ParameterSet(FILTER.declarations)
    optimiser = GaussNewton(TuneSettings(loss=losses), parameters)
    for step in range(9, 9 + steps):
        if optimiser.converged:
            break
        at = partial(expanded, parameters, log, losses)
        optimiser.step(step, lambda t: pytest.fail("no batch"), at, False)  # type: ignore[arg-type, return-value]
    return parameters


def known(parameters: ParameterSet, log: Log, losses: dict[str, float]) -> Certainty:
    return certainty(parameters, partial(expanded, parameters, log, losses))


def test_position_alone_determines_noises_only_as_a_ratio() -> None:
    """The gain of a filter in its steady state knows q / r, nothing else."""
    log = simulated(1, steps=40)
    wide = torch.eye(1).double().expand(24, 1, 1) * 1e6  # a start that fixes no scale
    assert log.start is not None
    log = Log(log.channels, log.time, log.z, log.truth, ("x",),
              start=Start(log.start.mean, wide, 0.0))  # fmt: skip
    found = known(optimum(log, POSITION), log, POSITION)
    (line,) = found.free
    assert Q in line
    assert R in line
    assert "only as a ratio" in line


def test_position_and_consistency_determine_both() -> None:
    log = simulated(2, batch=60)
    parameters = optimum(log, BOTH)
    found = known(parameters, log, BOTH)
    assert found.free == ()
    for name, true in ((Q, 0.7), (R, 1.0)):
        error = found.errors[name]
        assert error is not None
        assert abs(float(parameters.frozen_values()[name]) - true) < 4.0 * error
        assert 0.0 < error < 0.3 * true


def test_standard_errors_are_the_spread_over_independent_data() -> None:
    """Thirty data sets, each tuned by itself: the errors told are the scatter found."""
    values: dict[str, list[float]] = {Q: [], R: []}
    errors: dict[str, list[float]] = {Q: [], R: []}
    for seed in range(100, 130):
        log = simulated(seed, batch=60)
        parameters = optimum(log, BOTH)
        found = known(parameters, log, BOTH)
        for name in values:
            error = found.errors[name]
            assert error is not None
            values[name].append(float(parameters.frozen_values()[name]))
            errors[name].append(error)
    for name, each in values.items():
        spread = float(torch.tensor(each, dtype=torch.float64).std())
        told = float(torch.tensor(errors[name], dtype=torch.float64).mean())
        # 30 draws know their standard deviation to 13 %: two of those, and a little.
        assert told == pytest.approx(spread, rel=0.3), name


def test_a_scale_that_the_data_push_to_zero_is_told_as_free() -> None:
    """Nothing moves, so that no q is small enough."""
    log = simulated(3, q=0.0)
    parameters = optimum(log, BOTH, steps=25)
    assert float(parameters.frozen_values()[Q]) < 0.2
    found = known(parameters, log, BOTH)
    assert found.errors[Q] is None
    assert found.errors[R] is not None
    assert any(line.startswith(f"{Q}: the data do not determine it") for line in found.free)


def test_the_question_leaves_the_values_as_they_were() -> None:
    log = simulated(4)
    parameters = optimum(log, BOTH, steps=3)
    before = [x.detach().clone() for x in parameters.free().values()]
    known(parameters, log, BOTH)
    for x, y in zip(parameters.free().values(), before, strict=True):
        assert torch.equal(x, y)


def test_more_trajectories_make_errors_smaller_by_the_root() -> None:
    few, many = (simulated(5, batch=size) for size in (40, 640))
    told = [known(optimum(log, BOTH), log, BOTH).errors[R] for log in (few, many)]
    assert told[0] is not None
    assert told[1] is not None
    assert told[0] / told[1] == pytest.approx(4.0, rel=0.3)
