"""Forward tangents of the compiled step are the gradient that torch finds backwards."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from engine_cases import (
    LOSSES,
    SCENES,
    assert_same_gradient,
    irregular,
    leaves,
    short_log,
    value_and_gradient,
    with_reference,
)
from helpers import linear_filter, tensor
from torch import Tensor

from difffilter import Filter, Log, Start
from difffilter.engine.build import compiler
from difffilter.motions.blocks import ConstantVelocity, FunctionMotion
from difffilter.running.objectives import Problem, objective
from difffilter.sensors.position import Position
from difffilter.sensors.sensor import FunctionSensor
from difffilter.weights.registry import WEIGHTS, huber, igg3, tanh

pytestmark = [
    pytest.mark.skipif(compiler() is None, reason="no C compiler"),
    pytest.mark.usefixtures("quick_compiler"),
]

Overrides = tuple[tuple[str, object], ...]
ONE: Overrides = (("systems.huber.iterations", 1), ("systems.m-ekf.iterations", 2),
                  ("systems.m-ekf-all-rows.iterations", 1))  # fmt: skip
AIRPORT, LOCKOUT = "airport-mlat-intermittent", "gate-lockout"
#: Systems whose step has a soft form besides: all but the last five lines. Left out are
#: scenarios whose compiled steps are those of another (airborne-bearing-clean, -matched,
#: airport-mlat, manoeuvre-fusion-1, urban-credibility), and m-ekf-mad: compiling its five
#: sorts takes minutes, a small filter of that kind is tested in its place.
SOFT: list[tuple[str, str, Overrides]] = [
    *(("airborne-bearing", name, ()) for name in ("robust", "robust-noise", "gated")),
    *(("airborne-bearing-absolute", name, ()) for name in ("robust", "robust-noise", "gated")),
    *((AIRPORT, name, ONE) for name in ("huber", "m-ekf", "m-ekf-all-rows")),
    (AIRPORT, "ekf", (("systems.ekf.scope", "sensor"), ("systems.ekf.gate", "inflate"),
                      ("systems.ekf.weight", "barron"))),
    (AIRPORT, "ekf", (("systems.ekf.scope", "sensor"), ("systems.ekf.gate", "reweigh"),
                      ("systems.ekf.weight", "huber"), ("systems.ekf.distance", "mahalanobis"))),
    *((LOCKOUT, name, ()) for name in ("gated", "gated-widen", "gated-inflate")),
    *(("manoeuvre-fusion-2", name, ()) for name in
      ("robust-srckf", "lcasrckf", "rmckf", "fusion", "pooled-lcasrckf", "pooled-robust")),
    ("manoeuvre-fusion-2", "stf-srckf", ()),
    ("manoeuvre-fusion-2", "pooled-stf-srckf", ()),
]  # fmt: skip
#: Without any threshold: the hard form is the only one.
PLAIN: list[tuple[str, str, Overrides]] = [
    ("airborne-bearing", "ekf", ()),
    ("airborne-bearing", "clairvoyant", ()),
    ("airborne-bearing-absolute", "ekf", ()),
    ("airborne-bearing-multipath", "clairvoyant", ()),
    *((AIRPORT, name, ()) for name in ("ekf", "adaptive-ekf", "clairvoyant")),
    (AIRPORT, "ekf", (("systems.ekf.common_noise", True),)),
    (LOCKOUT, "ekf", ()),
    (LOCKOUT, "clairvoyant", ()),
    ("manoeuvre-fusion-2", "srckf", ()),
    *(("urban-credibility-2d", name, ()) for name in ("standard", "credibility", "ideal")),
    *(("urban-credibility-faulty", name, ()) for name in
      ("standard", "credibility", "ideal", "good", "good-standard", "clairvoyant")),
]  # fmt: skip


def named(case: tuple[str, str, Overrides]) -> str:
    return "-".join([case[0], case[1], *(str(value) for _, value in case[2])])


@pytest.mark.parametrize("case", [*SOFT, *PLAIN], ids=named)
def test_every_system_has_the_gradient_of_torch_in_its_hard_form(
    case: tuple[str, str, Overrides],
) -> None:
    assert_same_gradient(*short_log(*case))


@pytest.mark.parametrize("case", SOFT, ids=named)
def test_every_system_has_the_gradient_of_torch_in_its_soft_form(
    case: tuple[str, str, Overrides],
) -> None:
    assert_same_gradient(*short_log(*case), temperature=0.3)


def plane_log(steps: int = 20, batch: int = 3) -> Log:
    """Positions in the plane, some of them wild, with gaps and irregular times."""
    generator = torch.Generator().manual_seed(6)
    time = 0.5 * torch.arange(steps, dtype=torch.float64)
    truth = torch.stack([3.0 * (0.3 * time).cos(), 2.0 * time], -1).unsqueeze(1)
    truth = truth.expand(steps, batch, 2).clone()
    z = truth + torch.randn(truth.shape, generator=generator, dtype=torch.float64)
    wild = torch.rand(z.shape, generator=generator) < 0.15
    z = z + torch.where(wild, 6.0, 0.0)
    start = Start(torch.cat([truth[0], torch.ones(batch, 2).double()], -1))
    return irregular(Log(("x", "y"), time, z, truth, ("x", "y"), start=start))


def plane_filter(**options: object) -> Filter:
    sensor = Position(sigma=1.0)
    return Filter(ConstantVelocity(2, acceleration=0.8), (sensor,), start_sigma=1.5, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("temperature", [None, 0.3])
@pytest.mark.parametrize("name", WEIGHTS)
def test_every_weight_function_has_the_gradient_of_torch(
    name: str, temperature: float | None
) -> None:
    log = plane_log()
    filter = plane_filter(weight=WEIGHTS[name])
    log = replace(log, channels=filter.channels)
    if temperature is None or name != "plain":
        assert_same_gradient(filter, log, temperature)


@pytest.mark.parametrize("temperature", [None, 0.3])
@pytest.mark.parametrize("weight", [tanh, igg3])
def test_reweighting_with_prior_rows_and_mad_has_the_gradient_of_torch(
    weight: object, temperature: float | None
) -> None:
    filter = plane_filter(weight=weight, iterations=2, weigh_prior=True, mad=True)
    log = replace(plane_log(), channels=filter.channels)
    assert_same_gradient(filter, log, temperature)


def test_platform_inputs_have_the_gradient_of_torch() -> None:
    """The range sensor's stations come from the log, other ones for each trajectory."""
    filter, log = short_log(AIRPORT, "ekf")
    assert_same_gradient(filter, log.select([2, 0]))
    filter, log = short_log("airborne-bearing", "ekf")
    assert log.inputs  # where the aircraft is
    assert_same_gradient(filter, log)


@pytest.mark.parametrize("case", [SOFT[2], SOFT[7]], ids=named)
def test_the_loss_over_scenes_has_the_gradient_of_torch(case: tuple[str, str, Overrides]) -> None:
    filter, log = short_log(*case)
    losses = {"scenes": 1.0, "likelihood": 0.2}
    assert_same_gradient(filter, with_reference(filter, log), 0.3, losses, SCENES)


@pytest.mark.parametrize("scored", ["all", "measured"])
def test_rows_that_do_not_count_add_nothing_in_either_engine(scored: str) -> None:
    filter, log = short_log(LOCKOUT, "gated")
    assert_same_gradient(filter, log, 0.3, context=replace(SCENES, score=scored))


def test_central_differences_agree_with_the_fused_gradient() -> None:
    """An oracle that knows neither of the ways to differentiate."""
    filter = plane_filter(weight=tanh)
    log = replace(plane_log(), channels=filter.channels)
    _, gradient = value_and_gradient(filter, log, LOSSES, 0.3, "fused")
    at, step = 0, 1e-5
    for name, value in filter.published().items():
        for i in range(value.numel()):
            ends = []
            for side in (1.0, -1.0):
                moved = value.clone()
                moved.view(-1)[i] += side * step
                problem = Problem(filter, log, LOSSES, temperature=0.3, engine="torch")
                total, _ = objective(problem, {name: moved})
                ends.append(float(total))
            expected = (ends[0] - ends[1]) / (2.0 * step)
            assert float(gradient[at]) == pytest.approx(expected, rel=1e-5, abs=1e-7), name
            at += 1
    assert at == len(gradient)


def test_a_users_own_model_has_the_gradient_of_torch() -> None:
    def f(x: Tensor, dt: Tensor, inputs: object, values: object) -> Tensor:
        return torch.stack([x[..., 0] + dt * x[..., 1].sin(), 0.9 * x[..., 1]], dim=-1)

    motion = FunctionMotion(
        ("x", "vx"), f, lambda dt, v: torch.diag_embed(dt[..., None].expand(*dt.shape, 2) * 0.1)
    )
    sensor = FunctionSensor(("r",), lambda x, i, v: (x[..., :1].square() + 1.0).sqrt(), 0.3)
    z = tensor(np.linspace(1.0, 3.0, 20))[:, None, None].expand(20, 2, 1).clone()
    truth = 0.9 * z
    log = Log(("r",), torch.arange(20).double(), z, truth, ("x",))
    start = Start(tensor([[1.0, 0.1], [0.8, 0.2]]), torch.eye(2).double().expand(2, 2, 2))
    for rule in ("taylor", "cubature"):
        filter = Filter(motion, (sensor,), huber, linearise=rule)
        losses = {"likelihood": 1.0, "innovation-consistency": 0.5}
        assert_same_gradient(filter, replace(log, start=start), 0.3, losses)


def test_a_linear_sensor_with_other_noise_per_channel_has_the_gradient_of_torch() -> None:
    filter = linear_filter(weight=huber, start_sigma=2.0)
    generator = torch.Generator().manual_seed(2)
    z = 2.0 * torch.randn(12, 2, 3, generator=generator, dtype=torch.float64)
    start = Start(torch.zeros(2, 4).double())
    log = Log(filter.channels, 0.5 * torch.arange(12).double(), z, start=start)
    losses = {"likelihood": 1.0, "innovation-consistency": 1.0}
    assert leaves(filter)["linear.sigma"].shape == (3,)
    assert_same_gradient(filter, log, None, losses)
