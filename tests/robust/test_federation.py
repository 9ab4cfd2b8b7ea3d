"""Federated filters: the estimates of the central one, whatever the shares (the theorem)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from federated_cases import MOTION, SENSORS, federated, line, log_of, position, random_shares
from helpers import array, assert_close, random_spd, tensor
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import federated as oracle
from oracles import kinematics
from torch import Tensor

from difffilter.core.beliefs import Measurement, belief
from difffilter.core.conditioning import condition
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.filters.stepping import step
from difffilter.logs.track import Track
from difffilter.robust.federation import Federation
from difffilter.robust.gate import Gate
from difffilter.robust.recovery import Recovery
from difffilter.running.batch import run
from difffilter.running.tracker import Tracker
from difffilter.scenario.estimation import estimate
from difffilter.scenario.scenario import load_scenario
from difffilter.scenario.simulation import simulate
from difffilter.weights.registry import huber, igg3, imq, tanh

OPTIONS: dict[str, dict[str, object]] = {
    "plain": {},
    "huber": {"weight": huber},
    "m-ekf": {"weight": tanh, "iterations": 3},
    "m-ekf, all rows": {"weight": huber, "iterations": 2, "weigh_prior": True},
    "gate": {"weight": igg3, "gate": Gate("reject")},
    "sensors' weights": {"weight": imq, "scope": "sensor", "distance": "mahalanobis"},
    "recovery": {"gate": Gate("reject"), "recovery": Recovery("inflate", 1.0)},
}


def same(found: Track, expected: Track, tolerance: float = 1e-10) -> None:
    assert_close(found.mean, expected.mean, tolerance)
    assert_close(found.covariance, expected.covariance, tolerance)


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("name", SENSORS)
def test_a_federated_filter_estimates_what_the_central_one_does(
    rng: np.random.Generator, name: str, options: str
) -> None:
    central = Filter(MOTION, SENSORS[name], start_sigma=(5.0, 4.0, 2.0, 3.0), **OPTIONS[options])  # type: ignore[arg-type]
    log = log_of(central, rng)
    shares = random_shares(rng, len(SENSORS[name]))
    found = run(federated(name, shares=shares, **OPTIONS[options]), log)
    expected = run(central, log)
    same(found, expected)
    assert found.record is not None
    assert expected.record is not None
    assert_close(found.record.weight, expected.record.weight, 1e-9)
    assert not found.record.isolated.any()


@pytest.mark.parametrize("systems", [((0, 1), (2,)), ((0,), (1,), (2,)), ((2, 0), (1,))])
def test_everything_about_an_update_is_the_central_one(
    rng: np.random.Generator, systems: tuple[tuple[int, ...], ...]
) -> None:
    """Shift, covariance, residuals and what is left of the predicted measurement's."""
    rows, observed = tensor(rng.standard_normal((5, 4, 4))), tensor(rng.standard_normal((5, 3, 4)))
    innovation, noise = tensor(rng.standard_normal((5, 3))), tensor(rng.uniform(0.5, 4, (5, 3)))
    weight = tensor(rng.uniform(0.1, 1, (5, 3)))
    weight[2, 1] = 0.0
    expected = condition(rows, observed, innovation, weight, noise)
    federation = Federation(random_shares(rng, len(systems)), tuple(map(tuple, systems)))
    constants = federation.prepare(torch.float64)
    found = federation.condition(rows, observed, innovation, weight, noise, constants)
    assert_close(found.shift, expected.shift, 1e-11)
    assert_close(found.residual, expected.residual, 1e-11)
    joint, reference = (torch.cat([x.deviations, x.observed], -2) for x in (found, expected))
    assert_close(joint @ joint.mT, reference @ reference.mT, 1e-11)


@settings(max_examples=25)
@given(data=st.data())
def test_the_shares_never_move_an_estimate(data: st.DataObject) -> None:
    name = data.draw(st.sampled_from(list(SENSORS)))
    count = len(SENSORS[name])
    raw = np.array(data.draw(st.lists(st.floats(1e-3, 1.0), min_size=count, max_size=count)))
    log = log_of(federated(name), np.random.default_rng(7), steps=6, runs=2)
    even = run(federated(name), log)
    same(run(federated(name, shares=tuple((raw / raw.sum()).tolist())), log), even)


@pytest.mark.parametrize("count", [2, 3, 4])
def test_the_shares_do_not_matter_to_the_textbooks_federated_filter_nor_to_ours(
    rng: np.random.Generator, count: int
) -> None:
    """N local filters by explicit inverses, one Kalman filter, and the library: one result."""
    sensors = tuple(position(i, tuple(rng.uniform(2, 8, 2))) for i in range(count))
    motion = replace(MOTION, acceleration=1.5)
    filter = Filter(motion, sensors, federated=True, shares=random_shares(rng, count))
    state = belief(tensor(rng.standard_normal(4)), tensor(random_spd(rng, 4)))
    mean, covariance = array(state.mean), array(state.covariance)
    other, constants = random_shares(rng, count), filter.prepare()
    for _ in range(8):
        z, dt = 10.0 * rng.standard_normal((count, 2)), rng.uniform(0.1, 0.8)
        rows = np.eye(2, 4)
        systems = [
            (rows, np.diag(np.square(sensor.sigma)), y)
            for sensor, y in zip(sensors, z, strict=True)
        ]
        matrices = (kinematics.transition(2, dt), kinematics.discrete_noise(2.25 * np.eye(2), dt))
        central = oracle.central_step(mean, covariance, *matrices, systems)
        mean, covariance = oracle.federated_step(mean, covariance, *matrices, systems, other)
        assert_close(mean, central[0], 1e-9)
        assert_close(covariance, central[1], 1e-9)
        row = Measurement(tensor(z.reshape(-1)), tensor(dt))
        state, _ = step(filter, constants, state, row)
        assert_close(state.mean, mean, 1e-9)
        assert_close(state.covariance, covariance, 1e-9)


def test_the_theorem_holds_in_the_urban_scenario() -> None:
    scenario = load_scenario("urban-credibility", {"world.steps": 60})
    log = simulate(scenario, 3, seed=5)
    for name in ("standard", "credibility", "ideal"):
        expected = estimate(scenario.system(name), log)
        uneven = scenario.with_overrides({f"systems.{name}.shares": [0.03, 0.97]})
        same(estimate(uneven.system(name), log), expected)
        filter = scenario.system(name)
        assert isinstance(filter, Recipe)
        same(estimate(filter.centralised, log), expected)


@pytest.mark.parametrize("name", ["two positions", "common noise", "four"])
def test_a_singular_covariance_passes(rng: np.random.Generator, name: str) -> None:
    filter = federated(name)
    filter = replace(filter, motion=replace(MOTION, acceleration=((1.0, 0.0), (0.0, 1e-9))))
    log = log_of(filter, rng, steps=4, runs=2)
    covariance = np.zeros((4, 4))
    covariance[0, 0] = covariance[2, 2] = 4.0
    covariance[0, 2] = covariance[2, 0] = 4.0
    assert log.start is not None
    log = replace(log, start=replace(log.start, covariance=tensor(covariance)))
    found = run(filter, log)
    same(found, run(filter.centralised, log))
    assert bool(found.mean.isfinite().all())
    assert float(found.std[0, :, 1].max()) < 1e-3 < float(found.std[0, :, 0].min())


def test_a_certain_belief_stays_certain_whatever_is_measured() -> None:
    filter = federated("two positions")
    mean = tensor([1.0, 2.0, 3.0, 4.0])
    start = filter.start(mean, torch.zeros(4, 4).double())
    row = Measurement(tensor([9.0] * 4), tensor(0.0))
    after, _ = step(filter, filter.prepare(), start, row)
    assert torch.equal(after.mean, mean)
    assert not after.deviations.any()


@pytest.mark.parametrize("name", ["common noise", "four"])
def test_a_tracker_does_what_a_batch_run_does(rng: np.random.Generator, name: str) -> None:
    filter = federated(name, weight=huber)
    log = log_of(filter, rng)
    batch = run(filter, log)
    assert log.start is not None
    assert isinstance(batch.record, tuple)
    covariance = torch.diag(tensor((5.0, 4.0, 2.0, 3.0)).square())
    for i in range(log.trajectories):
        tracker = Tracker(filter, log.start.mean[i], covariance)
        for k, dt in enumerate(log.intervals(0.0).tolist()):
            record = tracker.step(log.z[k, i], dt)
            assert_close(tracker.belief.mean, batch.mean[k, i], 1e-12)
            assert_close(tracker.belief.covariance, batch.covariance[k, i], 1e-11)
            assert torch.equal(record.isolated, batch.record.isolated[k, i])


def test_one_trajectory_is_its_place_in_the_batch(rng: np.random.Generator) -> None:
    filter = federated("four", shares=(0.1, 0.2, 0.3, 0.4))
    log = log_of(filter, rng)
    batch = run(filter, log)
    assert log.start is not None
    start = replace(log.start, mean=log.start.mean[1])
    alone = replace(log, z=log.z[:, 1], truth=None, truth_states=(), start=start)
    assert_close(run(filter, alone).mean, batch.mean[:, 1], 1e-13)


@pytest.mark.parametrize("options", ["plain", "m-ekf"])
@pytest.mark.parametrize("name", ["two positions", "common noise", "four"])
def test_a_federated_step_passes_gradcheck_towards_every_parameter(
    rng: np.random.Generator, name: str, options: str
) -> None:
    filter = federated(name, shares=random_shares(rng, len(SENSORS[name])), **OPTIONS[options])
    log = log_of(filter, rng, steps=2, runs=1)
    names = list(filter.declarations)
    free = [
        filter.declarations[n].constraint.free(v).requires_grad_()
        for n, v in filter.published().items()
    ]

    def posterior(*free: Tensor) -> tuple[Tensor, Tensor]:
        values = {
            n: filter.declarations[n].constraint.physical(u)
            for n, u in zip(names, free, strict=True)
        }
        track = run(filter, log, values, temperature=0.5)
        return track.mean[-1], track.covariance[-1]

    assert torch.autograd.gradcheck(posterior, free, atol=1e-5, rtol=1e-4, eps=1e-5)


def test_the_gradient_is_the_central_filters(rng: np.random.Generator) -> None:
    filter = federated("full R", shares=(0.2, 0.3, 0.5), weight=huber)
    log = log_of(filter, rng, steps=5, runs=2)

    def gradients(of: Filter) -> list[Tensor]:
        values = {name: v.requires_grad_() for name, v in of.published().items()}
        track = run(of, log, values, temperature=0.3)
        total = track.mean.square().mean() + track.covariance.square().sum()
        return list(torch.autograd.grad(total, list(values.values())))

    for found, expected in zip(gradients(filter), gradients(filter.centralised), strict=True):
        assert_close(found, expected, 1e-9)


def test_shares_are_no_parameter() -> None:
    assert not [name for name in federated("four").declarations if "share" in name]
    even, uneven = federated("four"), federated("four", shares=(0.1, 0.2, 0.3, 0.4))
    assert even.declarations == uneven.declarations == even.centralised.declarations


@pytest.mark.parametrize(
    ("shares", "message"),
    [
        ((0.5, 0.6), r"shares: found \[0\.5, 0\.6\], expected two or more above 0 whose sum is 1"),
        ((1.5, -0.5), "shares: found .* above 0"),
        ((1.0, 0.0), "shares: found .* above 0"),
        ((float("nan"), 0.5), "shares: found .* above 0"),
        ((0.2, 0.3, 0.5), "shares: found 3, expected 2, one for each sensor"),
    ],
)
def test_shares_that_are_none_are_refused(shares: tuple[float, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        federated("two positions", shares=shares)


def test_one_sensor_is_no_federation() -> None:
    with pytest.raises(InputError, match=r"shares: found \[1\.0\], expected two or more"):
        Filter(MOTION, (position(1),), federated=True)
    with pytest.raises(InputError, match=r"shares: found \[1\.0\], expected two or more"):
        Federation((1.0,))


def test_shares_without_local_filters_are_refused() -> None:
    with pytest.raises(InputError, match="shares: expected federated with them"):
        Filter(MOTION, (position(1), position(2)), shares=(0.5, 0.5))


def test_the_central_form_has_no_local_filter_and_a_central_filter_is_its_own() -> None:
    filter = federated("four", shares=(0.1, 0.2, 0.3, 0.4))
    central = filter.centralised
    assert central.federation is None
    assert central.shares == ()
    assert central.centralised is central
    assert filter.federation is not None
    assert filter.federation.systems == 4
    assert line(np.random.default_rng(1)).filter.members == ((0,), (1,))
