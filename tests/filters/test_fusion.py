"""Distributed fusion of one robust and two adaptive subsystems, against an oracle in NumPy."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from fusion_cases import (
    P0,
    SCENES,
    bent_log,
    estimated,
    free_values,
    fused,
    measured,
    physical,
    position,
)
from helpers import array, assert_close, number, one, tensor
from oracles import cubature
from stream_cases import stream
from torch import Tensor

from difffilter import load_scenario
from difffilter.adaptation.matching import FLAG, MATCHED
from difffilter.core.beliefs import Belief, Measurement
from difffilter.errors import InputError
from difffilter.filters.fusion import Fusion
from difffilter.filters.stepping import step
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.batch import run
from difffilter.running.tracker import Tracker
from difffilter.sensors.builtin import Position, Range

NAN = torch.nan
DEVIATIONS = torch.diag(tensor(P0.diagonal() ** 0.5))


@pytest.mark.parametrize("name", SCENES)
def test_over_a_whole_scene_the_fusion_is_that_of_the_oracle(name: str) -> None:
    track = estimated(name, "fusion")
    z, start = measured(name, "r", "a1", "a2")
    assert track.record is not None
    for b in range(2):
        mean, cov, flags = cubature.fusion(
            z[:, b], start[b], P0, np.full(2, 50.0), np.full(2, 100.0)
        )
        assert_close(track.mean[:, b], mean, 1e-12)
        assert_close(track.covariance[:, b], cov, 1e-9)
        coarse = array(track.record.weight[:, b, 2:])
        assert_close(coarse, np.tile(~flags[:, None], 4).astype(float), 1e-14)
        assert flags.any() == (name == SCENES[1])


@pytest.mark.parametrize("seed", range(4))
def test_flags_and_corrections_in_any_order_are_those_of_the_oracle(seed: int) -> None:
    filter = fused()
    log = bent_log(filter, 20, 2, seed)
    z = log.z.clone()
    generator = torch.Generator().manual_seed(seed)
    rows = torch.rand(20, generator=generator) < 0.3
    z[rows] += 250.0 * torch.randn(int(rows.sum()), 1, 1, generator=generator).double()
    log = replace(log, z=z)
    assert log.start is not None
    track = run(filter, log)
    for b in range(2):
        mean, cov, flags = cubature.fusion(
            array(z[:, b]), array(log.start.mean[b]), P0, np.full(2, 49.0), np.full(2, 100.0)
        )
        assert flags.any()
        assert not flags.all()
        assert_close(track.mean[:, b], mean, 1e-10)
        assert_close(track.covariance[:, b], cov, 1e-9)


def test_with_taylor_the_linear_fusion_is_the_same() -> None:
    log = bent_log(fused())
    found, expected = run(fused("taylor"), log), run(fused(), log)
    assert_close(found.mean, expected.mean, 1e-11)
    assert_close(found.covariance, expected.covariance, 1e-10)


def test_streaming_is_the_batch_run() -> None:
    filter = fused()
    log = bent_log(filter)
    z = log.z.clone()
    z[2, 0, :2] = z[6, 1, 2:] = z[8, 2] = NAN
    log = replace(log, z=z, truth=None, truth_states=())
    expected = run(filter, log)
    assert log.start is not None
    assert expected.final is not None
    assert expected.record is not None
    found = stream(Tracker(filter, log.start.mean, tensor(P0).expand(3, 4, 4)), log)
    assert_close(found.mean, expected.mean, 1e-12)
    assert_close(found.covariance, expected.covariance, 1e-11)
    assert found.final is not None
    assert found.record is not None
    for key, value in expected.final.memory.items():
        assert_close(found.final.memory[key], value, 1e-11)
    assert_close(found.record.innovation, expected.record.innovation, 1e-11)


def test_each_trajectory_is_the_one_run_alone() -> None:
    filter = fused()
    log = bent_log(filter)
    together = run(filter, log)
    for i in range(3):
        alone = run(filter, log.select([i]))
        assert_close(together.mean[:, i], alone.mean[:, 0], 1e-12)
        assert_close(together.covariance[:, i], alone.covariance[:, 0], 1e-11)


def test_the_start_is_that_of_every_subsystem() -> None:
    filter = fused()
    mean = tensor([[1.0, 2.0, 3.0, 4.0], [5.0, 6.0, 7.0, 8.0]])
    started = filter.start(mean, DEVIATIONS.expand(2, 4, 4))
    for i in range(3):
        assert torch.equal(started.memory[f"fusion.mean.{i}"], mean)
        assert torch.equal(started.memory[f"fusion.deviations.{i}"], started.deviations)
    assert not started.memory[MATCHED].any()
    assert len(filter.subsystems) == 3
    for i, part in enumerate(filter.subsystems):
        assert part.sensors == filter.sensors[i : i + 1]
        assert part.linearise == "cubature"


def test_a_record_tells_of_all_sensors_about_the_fused_prediction() -> None:
    filter = fused()
    state = filter.start(torch.zeros(2, 4).double(), DEVIATIONS.expand(2, 4, 4))
    z = tensor([[3.0, 1.0, 5.0, 0.0, -4.0, 2.0], [300.0, 1.0, 305.0, 0.0, 296.0, 2.0]])
    z[0, 3] = NAN
    _, record = one(filter, state, z, 1.0)
    assert record.weight.shape == record.innovation.shape == record.noise.shape == (2, 6)
    assert record.observed.shape == (2, 6, 8)
    assert record.prior_weight.shape == (2, 4)
    assert record.present.tolist() == [[True] * 3 + [False] + [True] * 2, [True] * 6]
    assert record.weight[0].tolist() == pytest.approx([1.0] * 3 + [0.0] + [1.0] * 2)
    assert record.gate[:, 0].tolist() == [1.0, 0.0]
    assert record.weight[1, 2:].tolist() == [0.0] * 4  # flagged: the coarse ones count nothing
    assert 0.0 < number(record.weight[1, 0]) < 0.1  # and the robust one as much as matched
    # Nothing corrected in trajectory 0, so the fused prediction is everyone's.
    prediction = P0[0, 0] + P0[2, 2] + 1.0
    assert_close(record.innovation[0], array(z[0].nan_to_num()), 1e-9)
    variance = prediction + np.array([49.0] * 2 + [100.0] * 4)
    assert_close(record.innovation_variance[0], variance, 1e-10)
    assert_close(record.standardised, record.innovation * record.innovation_variance.rsqrt(), 1e-12)
    assert bool(torch.isfinite(record.nis).all())


@pytest.mark.parametrize("rule", ["taylor", "cubature"])
def test_with_the_robust_sensor_missing_the_coarse_ones_go_on(rule: str) -> None:
    """Unflagged and uncorrected; then each coarse subsystem has only its own sensor."""
    filter = fused(rule)
    state = filter.start(torch.zeros(4).double(), DEVIATIONS)
    z = tensor([NAN, NAN, 5.0, 0.0, -4.0, 2.0])
    after, record = one(filter, state, z, 1.0)
    prior = cubature.predict(np.zeros(4), P0)
    both = 0.5 * (array(z[2:4]) + array(z[4:]))
    expected = cubature.update(*prior, both, np.full(2, 50.0))
    assert_close(after.mean, expected[0], 1e-11)
    assert_close(after.covariance, expected[1], 1e-10)
    assert record.weight.tolist() == pytest.approx([0.0, 0.0, 1.0, 1.0, 1.0, 1.0])
    for i, own in ((1, z[2:4]), (2, z[4:])):
        alone = cubature.update(*prior, array(own), np.full(2, 100.0))
        assert_close(after.memory[f"fusion.mean.{i}"], alone[0], 1e-11)
    assert_close(after.memory["fusion.mean.0"], prior[0], 1e-12)
    assert number(after.memory[FLAG]) == 0.0


@pytest.mark.parametrize("rule", ["taylor", "cubature"])
def test_with_the_coarse_sensors_missing_all_have_the_robust_one(rule: str) -> None:
    filter = fused(rule)
    state = filter.start(torch.zeros(4).double(), DEVIATIONS)
    after, record = one(filter, state, tensor([5.0, -3.0, NAN, NAN, NAN, NAN]), 1.0)
    prior = cubature.predict(np.zeros(4), P0)
    expected = cubature.update(*prior, np.array([5.0, -3.0]), np.full(2, 49.0))
    assert_close(after.mean, expected[0], 1e-11)
    assert_close(after.covariance, expected[1], 1e-10)
    for i in range(3):
        assert_close(after.memory[f"fusion.mean.{i}"], expected[0], 1e-11)
    assert record.weight.tolist() == pytest.approx([1.0, 1.0, 0.0, 0.0, 0.0, 0.0])


def test_with_all_sensors_missing_every_subsystem_predicts() -> None:
    filter = fused()
    log = bent_log(filter)
    short = replace(log, z=log.z[:6], time=log.time[:6], truth=None, truth_states=())
    before = run(filter, short).final
    assert before is not None
    after, record = one(filter, before, torch.full((3, 6), NAN).double(), 1.0)
    for i in range(3):
        expected = array(before.memory[f"fusion.mean.{i}"]) @ cubature.F.T
        assert_close(after.memory[f"fusion.mean.{i}"], expected, 1e-12)
    priors = [array(after.memory[f"fusion.mean.{i}"]) for i in (1, 2)]
    assert np.isfinite(array(after.covariance)).all()
    low, high = np.minimum(*priors), np.maximum(*priors)
    assert bool((array(after.mean) >= low - 3.0).all())
    assert bool((array(after.mean) <= high + 3.0).all())
    assert not record.weight.any()
    assert not record.innovation.any()
    assert torch.equal(after.memory[MATCHED], before.memory[MATCHED])


def test_a_wrong_fusion_is_an_input_error() -> None:
    motion, sensors = ConstantVelocity(2), tuple(position(n) for n in ("a", "b", "c"))
    kinds = (Position(), position("b"), Range(stations=((0.0, 0.0), (9.0, 0.0)), sigma=1.0))
    message = "fusion: expected three sensors or more of one kind and size"
    for wrong in (sensors[:2], kinds):
        with pytest.raises(InputError, match=message):
            Fusion(motion, wrong)
    assert Fusion(motion, sensors).channels[:2] == ("x_a", "y_a")


BESIDE: tuple[dict[str, object], ...] = (
    {"weight": "huber"},
    {"weight": "huber", "iterations": 2},
    {"gate": "reject"},
    {"recovery": "widen", "gate": "reject"},
    {"adaptation": "strong-tracking"},
    {"federated": True},
    {"clairvoyant": True},
)


@pytest.mark.parametrize("options", BESIDE)
def test_options_of_a_filter_do_not_go_with_fusion(options: dict[str, object]) -> None:
    changed = {f"systems.fusion.{key}": value for key, value in options.items()}
    with pytest.raises(InputError, match="expected no weight, gate or other option with fusion"):
        load_scenario("manoeuvre-fusion-1", changed)


def test_the_soft_form_becomes_the_hard_one_as_the_temperature_falls() -> None:
    filter = fused()
    log = bent_log(filter)
    hard = run(filter, log).mean
    errors = [
        number((run(filter, log, temperature=t).mean - hard).abs().max())
        for t in (0.5, 0.02, 1e-3, 1e-5)
    ]
    assert errors[0] > 0.01
    assert errors[-1] < 0.01 * errors[0]


@pytest.mark.parametrize("rule", ["taylor", "cubature"])
def test_the_soft_form_has_a_gradient_towards_every_parameter(rule: str) -> None:
    filter = fused(rule)
    log = bent_log(filter)
    assert log.truth is not None
    z = log.z.clone()
    z[7, 0, 0] = z[8, 1, 2:] = z[9, 2] = NAN
    names, free = free_values(filter)
    assert {"matching.beta", "matching.rate", "correction.lambda", "a2.sigma"} <= set(names)
    track = run(filter, replace(log, z=z), physical(filter, free), temperature=0.5)
    loss = (track.mean - log.truth).square().mean() + track.covariance.square().mean()
    for key, gradient in zip(names, torch.autograd.grad(loss, free), strict=True):
        assert bool(torch.isfinite(gradient).all()), key
        assert bool(gradient.any()), key


def test_a_hard_run_has_a_finite_gradient_too() -> None:
    filter = fused()
    log = bent_log(filter)
    names, free = free_values(filter)
    track = run(filter, log, physical(filter, free))
    gradients = torch.autograd.grad(track.mean.square().mean(), free, allow_unused=True)
    found = dict(zip(names, gradients, strict=True))
    for key in ("r.sigma", "a1.sigma", "motion.state_sigma", "correction.lambda"):
        assert found[key] is not None
        assert bool(torch.isfinite(found[key]).all())
        assert bool(found[key].any())


def test_a_soft_step_passes_gradcheck() -> None:
    filter = fused()
    log = bent_log(filter)
    short = replace(log, z=log.z[:6], time=log.time[:6], truth=None, truth_states=())
    state = run(filter, short).final
    assert state is not None
    state = Belief(state.mean[0], state.deviations[0], {k: v[0] for k, v in state.memory.items()})
    names, free = free_values(filter)
    at = names.index("start.sigma")
    start = filter.declarations["start.sigma"]
    rest = [*free[:at], *free[at + 1 :]]
    keys = [f"fusion.mean.{i}" for i in range(3)]

    def posterior(*given: Tensor) -> tuple[Tensor, ...]:
        means, free = given[:3], given[3:]
        full = [*free[:at], start.constraint.free(start.tensor()), *free[at:]]
        constants = filter.prepare(physical(filter, full), temperature=0.5)
        before = state._replace(memory={**state.memory, **dict(zip(keys, means, strict=True))})
        after, record = step(filter, constants, before, Measurement(log.z[6, 0], tensor(1.0)))
        return after.mean, after.covariance, record.weight, record.innovation

    means = [state.memory[key].clone().requires_grad_() for key in keys]
    assert torch.autograd.gradcheck(posterior, (*means, *rest), atol=1e-5, rtol=1e-4, eps=1e-5)
