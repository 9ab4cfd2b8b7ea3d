"""Tuning on a family of worlds: the mean gain counts, and no member may get worse."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from tune_cases import FEW, airport

from difffilter.errors import InputError
from difffilter.logs.family import Family, Member
from difffilter.parameters.parameters import ParameterSet
from difffilter.scenario.families import family
from difffilter.scenario.scenario import Scenario
from difffilter.scoring.losses import LOSSES
from difffilter.scoring.metrics import position_error
from difffilter.tuning.curvature import chain_rule, expand
from difffilter.tuning.guards import held_to, toward
from difffilter.tuning.loop import tune
from difffilter.tuning.task import Task

WORLDS: list[dict[str, Any]] = [
    {"name": "base", "weight": 3.0},
    {"name": "clean", "overrides": {"faults.nlos.probability": 0.0}},
    {"name": "longer", "role": "tune", "overrides": {"world.steps": 15}},
]


def scenario() -> Scenario:
    return airport(worlds=WORLDS)


def task(engine: str = "torch", **loss: float) -> Task:
    made = scenario()
    system: Any = made.system("m-ekf")
    settings = replace(made.tuning, **(FEW | {"trajectories": 24, "loss": {"worlds": 1.0} | loss}))
    return Task(made, system, settings, 3, asked=engine)


def by_hand(squared: list[float], published: list[float]) -> float:
    """Weighted mean of log RMSE ratios of base and longer, and round hinges of all three."""
    ratios = [0.5 * math.log(s / p) for s, p in zip(squared, published, strict=True)]
    gain = (3.0 * ratios[0] + ratios[2]) / 4.0
    over = [r - math.log(1.02) for r in ratios]
    return gain + sum(x + math.hypot(x, 0.01) for x in over)


@pytest.mark.parametrize("factor", [0.6, 1.0, 1.3])
def test_the_loss_is_the_mean_gain_and_a_hinge_for_each_member(factor: float) -> None:
    job = task()
    values = job.filter.published()
    values["tdoa.sigma"] = factor * values["tdoa.sigma"]
    track = job.track(values)
    log = job.check.log
    errors = position_error(log, track).nan_to_num()
    own = position_error(log, job.track(job.filter.published())).nan_to_num()
    parts = [slice(8 * i, 8 * i + 8) for i in range(3)]
    sums = [[float(x[:, part].sum()) for part in parts] for x in (errors, own)]
    found = float(LOSSES["worlds"](track, log, job.context))
    assert found == pytest.approx(by_hand(*sums), abs=1e-12)
    assert job.validate(values) == pytest.approx(found, abs=1e-12)


def test_members_draw_what_they_draw_alone_and_padded_rows_do_not_count() -> None:
    job = task()
    log, made = job.parts[0], scenario()
    assert log.z.shape[:2] == (15, 24)
    for i, member in enumerate(family(made)):
        alone = member.log(8, 3, "train")
        own = log.z[: alone.steps, 8 * i : 8 * i + 8]
        assert torch.equal(own.nan_to_num(), alone.only(log.channels).z.nan_to_num())
        assert not bool(log.measured[alone.steps :, 8 * i : 8 * i + 8].any())


@pytest.mark.usefixtures("quick_compiler")
def test_gauss_newton_knows_gradient_and_curvature_of_the_family() -> None:
    """Against autograd, and J^T J of each member's residuals weighed by its own slope."""
    job = task("fused")
    assert job.optimiser == "adam"  # as the settings say
    assert replace(job, settings=replace(job.settings, optimiser="auto")).optimiser == (
        "gauss-newton"
    )
    parameters = ParameterSet(job.filter.declarations)
    batch = job.data.batch(torch.arange(job.count))
    found = job.expand(parameters, batch, 0.3)
    slow = replace(job, asked="torch")
    loss, _ = slow.loss(parameters.values(), batch, 0.3)
    free = list(parameters.free().values())
    gradient = torch.cat([g.reshape(-1) for g in torch.autograd.grad(loss, free)])
    assert found.loss == pytest.approx(float(loss.detach()), abs=1e-9)
    assert torch.allclose(found.gradient, gradient, rtol=1e-6, atol=1e-9)
    assert float(torch.linalg.eigvalsh(found.curvature).min()) > -1e-9
    from difffilter.running.objectives import sum_losses

    sums = sum_losses(job.problem(batch, 0.3), parameters.values())
    weight = torch.tensor([3.0, 0.0, 1.0], dtype=torch.float64) / 4.0
    squared = sums.values.detach().reshape(3, 8, 3, 4)[..., 0].sum(1).diagonal()
    reference = sums.values.detach().reshape(3, 8, 3, 4)[..., 1].sum(1).diagonal()
    over = 0.5 * (squared / (1.02**2 * reference)).log()
    steep = 1.0 + over / (over.square() + 1e-4).sqrt()
    slopes = ((weight + steep) * 0.5 / squared).repeat_interleave(8)
    chain = chain_rule(parameters)
    gram = 2.0 * (slopes[:, None, None] * (chain.mT @ sums.gram @ chain)).sum(0)
    bare = expand({"worlds": 1.0}, sums, parameters, 0.0, inputs=batch.log.inputs)
    rest = bare.curvature - gram
    assert float(torch.linalg.eigvalsh(0.5 * (rest + rest.mT)).min()) > -1e-8


def test_a_family_is_tuned_and_says_so() -> None:
    made = scenario()
    loss = {"worlds": 1.0}
    first = tune(made, loss=loss, settings=FEW | {"learning_rate": 0.3}, seed=1)
    assert first.history[0].validation == pytest.approx(by_hand([1.0] * 3, [1.0] * 3), abs=1e-12)
    assert first.checkpoint.training["loss"] == loss
    assert first.checkpoint.training["validation_loss"] < first.history[0].validation
    assert set(first.checkpoint.training["guards"]) == {"share", "worst", "upper"}


def test_values_go_back_until_no_member_is_worse_than_it_may_be() -> None:
    """One that is worse than allowed gives way; published values alone never do."""
    made = scenario()
    filter: Any = made.system("m-ekf")
    values = filter.published()
    values["tdoa.sigma"] = 12.0 * values["tdoa.sigma"]
    strict = Family(tuple(replace(m, source=drawing(m)) for m in family(made)))
    held = held_to(strict, filter, values, 3, engine="torch")
    assert 0.0 <= held.share < 1.0
    assert held.upper > 1.02
    expected = toward(filter, values, held.share) if held.share else filter.published()
    assert torch.equal(held.values["tdoa.sigma"], expected["tdoa.sigma"])
    free = Family(tuple(replace(m, allow=1e9) for m in strict))
    assert held_to(free, filter, values, 3, engine="torch").share == 1.0


def drawing(member: Member) -> Any:
    """Few trajectories, however many are asked for."""
    return lambda count, seed, purpose: member.log(8, seed, purpose)


def test_half_of_the_way_is_the_geometric_mean_of_a_scale() -> None:
    filter: Any = scenario().system("m-ekf")
    values = filter.published()
    published = values["tdoa.sigma"]
    values["tdoa.sigma"] = 4.0 * published
    assert torch.allclose(toward(filter, values, 0.5)["tdoa.sigma"], 2.0 * published)


def test_worlds_without_any_are_refused() -> None:
    with pytest.raises(InputError, match=r"loss worlds: found no \[\[worlds\]\]"):
        tune(airport(worlds=[]), loss={"worlds": 1.0}, settings=FEW)
