"""Credibility of systems and of the prediction, against explicit inverse covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from federated_cases import Line, line, random_shares
from helpers import STATIONS, Array, array, assert_close, tensor
from hypothesis import given
from hypothesis import strategies as st
from oracles import federated as oracle
from torch import Tensor

from difffilter.adaptation.credibility import Credibility
from difffilter.core.beliefs import Measurement
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.stepping import step
from difffilter.logs.log import Log
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.sensors.builtin import TDOA, Position
from difffilter.weights.registry import tanh

NAMES = ("rate", "power", "floor", "followed", "kappa", "drift_rate")
NAN = torch.nan
#: Points of the mapping: the published one, one for each extension, all at once.
POINTS: dict[str, oracle.Mapping] = {
    "published": oracle.Mapping(),
    "power": oracle.Mapping(power=0.4),
    "floor": oracle.Mapping(floor=6.0, rate=0.3),
    "followed": oracle.Mapping(followed=0.7),
    "wholly followed": oracle.Mapping(followed=1.0),
    "prediction": oracle.Mapping(kappa=30.0, drift_rate=0.2),
    "all": oracle.Mapping(0.25, 1.6, 2.0, 0.3, 12.0, 0.1),
}
#: Axes and each system's sigma.
CASES: dict[str, tuple[int, tuple[object, ...]]] = {
    "one axis": (1, (3.0, 5.0)),
    "three systems": (1, (3.0, 5.0, 2.0)),
    "two axes": (2, (3.0, 5.0)),
    "sigma per axis": (2, ((3.0, 6.0), 5.0, (2.0, 4.0))),
}


def values_of(mapping: oracle.Mapping) -> Values:
    return {f"credibility.{name}": tensor(getattr(mapping, name)) for name in NAMES}


def expected(made: Line, mapping: oracle.Mapping, **options: object) -> tuple[Array, Array, Array]:
    """The oracle's run of a case."""
    filter, n = made.filter, made.filter.motion.axes  # type: ignore[attr-defined]
    variances = np.concatenate(
        [np.broadcast_to(np.square(s.sigma), (n,)) for s in filter.sensors]  # type: ignore[attr-defined]
    )
    dt = np.diff(np.concatenate([[0.0], array(made.log.time)]))
    return oracle.credibility_run(
        array(made.log.z), dt, made.mean, made.covariance, filter.motion.acceleration,  # type: ignore[attr-defined]
        variances, filter.members, n, mapping, **options,  # type: ignore[arg-type]
    )  # fmt: skip


@pytest.mark.parametrize("point", POINTS)
@pytest.mark.parametrize("case", CASES)
def test_a_run_is_the_oracles(rng: np.random.Generator, case: str, point: str) -> None:
    axes, sigmas = CASES[case]
    made = line(rng, axes, sigmas)
    track = run(made.filter, made.log, values_of(POINTS[point]))
    mean, covariance, _ = expected(made, POINTS[point], shares=random_shares(rng, len(sigmas)))
    assert_close(track.mean, mean, 1e-9)
    assert_close(track.covariance, covariance, 1e-8)


def test_random_values_of_the_mapping_give_the_oracles_run(rng: np.random.Generator) -> None:
    for seed in range(8):
        made = line(np.random.default_rng(seed), 1 + seed % 2, (3.0, 5.0, 4.0)[: 2 + seed % 2])
        rate, b = rng.uniform(0.01, 0.9, 2)
        point = oracle.Mapping(
            rate, rng.uniform(0.1, 3), rng.uniform(0, 20), rng.uniform(), rng.uniform(0, 80), b
        )
        mean, covariance, _ = expected(made, point)
        track = run(made.filter, made.log, values_of(point))
        assert_close(track.mean, mean, 1e-9)
        assert_close(track.covariance, covariance, 1e-8)


@pytest.mark.parametrize("case", CASES)
def test_without_credibility_a_run_is_the_federated_oracles(
    rng: np.random.Generator, case: str
) -> None:
    """A power of almost 0, everything conserved: gamma_i as sure as the systems' geometry."""
    axes, sigmas = CASES[case]
    made = line(rng, axes, sigmas)
    mapping = oracle.Mapping(power=1e-12)
    track = run(made.filter, made.log, values_of(mapping))
    mean, _, gamma = expected(made, mapping)
    assert_close(track.mean, mean, 1e-9)
    every = ~torch.isnan(made.log.z).any(-1)
    even = gamma[array(every).astype(bool)]
    assert np.abs(even - 1.0 / len(sigmas)).max() < 1e-6


@pytest.mark.parametrize("case", CASES)
def test_the_ideal_filter_is_the_oracles(rng: np.random.Generator, case: str) -> None:
    made = line(rng, *CASES[case], ideal=True)
    told = oracle.Told(*(array(made.log.inputs[f"ideal.{name}"]) for name in
                         ("error", "variance", "process")))  # fmt: skip
    mean, covariance, _ = expected(made, oracle.Mapping(), told=told)
    track = run(made.filter, made.log)
    assert_close(track.mean, mean, 1e-9)
    assert_close(track.covariance, covariance, 1e-8)
    own = replace(made.log, inputs={**made.log.inputs, "ideal.process": torch.full((40,), NAN)})
    assert not torch.allclose(run(made.filter, own).mean, track.mean)


def test_the_published_point_is_equation_10() -> None:
    """gamma_i = (1 / R'_i) / sum (1 / R'_j), and the share of the total information."""
    mapping = Credibility(((0,), (1,), (2,)), 1)
    averaged, nominal = tensor([4.0, 9.0, 100.0]), tensor([9.0, 25.0, 16.0])
    published = {p.name: p.tensor() for p in mapping.parameters}
    observed, present = tensor([[2.0, 1.0]] * 3), torch.ones(3, dtype=torch.bool)
    weight = mapping.weights(observed, nominal, averaged, present, published)
    gamma = (1.0 / averaged) / (1.0 / averaged).sum()
    total = (1.0 / nominal).sum()
    assert_close(weight / nominal, gamma * total, 1e-11)
    found = mapping.shares(tensor([1.0] * 3), averaged, present, published)
    assert_close(found, gamma, 1e-14)


def shares_of(
    systems: int, geometry: Tensor, averaged: Tensor, present: Tensor, p: float
) -> Tensor:
    mapping = Credibility(tuple((i,) for i in range(systems)), 1)
    values = {"credibility.power": tensor(p), "credibility.floor": tensor(0.3)}
    return mapping.shares(geometry, averaged, present, values)


@given(
    data=st.data(),
    systems=st.integers(2, 5),
    p=st.floats(0.05, 4.0),
)
def test_shares_are_positive_where_present_and_add_up_to_one(
    data: st.DataObject, systems: int, p: float
) -> None:
    def drawn(each: st.SearchStrategy[float]) -> Tensor:
        return tensor(data.draw(st.lists(each, min_size=systems, max_size=systems)))

    geometry, averaged = drawn(st.floats(1e-6, 1e6)), drawn(st.floats(1e-12, 1e12))
    present = torch.tensor(data.draw(st.lists(st.booleans(), min_size=systems, max_size=systems)))
    gamma = shares_of(systems, geometry, averaged, present, p)
    assert bool((gamma >= 0.0).all())
    assert not gamma[~present].any()
    assert float(gamma.sum()) == pytest.approx(1.0 if bool(present.any()) else 0.0, abs=1e-12)
    near = shares_of(systems, geometry.clamp(0.1, 10), averaged.clamp(0.1, 10), present, p)
    assert bool((near[present] > 0.0).all())


@given(data=st.data(), scale=st.floats(1.1, 50.0), p=st.floats(0.1, 3.0))
def test_a_worse_system_is_given_less(data: st.DataObject, scale: float, p: float) -> None:
    averaged = tensor(data.draw(st.lists(st.floats(1.0, 100.0), min_size=3, max_size=3)))
    every, ones = torch.ones(3, dtype=torch.bool), tensor([1.0] * 3)
    before = shares_of(3, ones, averaged, every, p)
    after = shares_of(3, ones, averaged * tensor([scale, 1.0, 1.0]), every, p)
    assert float(after[0]) < float(before[0])
    assert float(after[1] / after[2]) == pytest.approx(float(before[1] / before[2]), rel=1e-9)


def weight_and_gradients(
    made: Line, z: Tensor, memory: dict[str, Tensor]
) -> tuple[Tensor, list[Tensor]]:
    """Effective weights of one step from the record, and every gradient of the posterior."""
    filter = made.filter
    inside = filter.published() | {"credibility.kappa": tensor(5.0)}
    values = {name: v.requires_grad_() for name, v in inside.items()}
    constants = filter.prepare(values)
    start = filter.start(tensor(made.mean), torch.diag(tensor((3.0, 1.0))))
    start = start._replace(memory={**start.memory, **memory})
    after, record = step(filter, constants, start, Measurement(z, tensor(0.2)))
    again, _ = step(filter, constants, after, Measurement(z, tensor(0.2)))
    total = again.mean.square().sum() + again.covariance.sum()
    gradients = torch.autograd.grad(
        total, list(values.values()), allow_unused=True, materialize_grads=True
    )
    weight = (filter.published()["p1.sigma"].square(), filter.published()["p2.sigma"].square())
    return torch.stack(weight) / record.noise.detach(), list(gradients)


@pytest.mark.parametrize(
    "measured",
    [(0.0, 4.0), (4.0, 0.0), (0.0, 0.0), (NAN, 3.0), (0.0, NAN), (NAN, NAN), (1e-160, 4.0),
     (1e8, -1e8)],
)  # fmt: skip
@pytest.mark.parametrize("averaged", [1.0, 0.0, 1e-300])
def test_weights_and_gradients_are_finite_at_zero_errors_and_absent_systems(
    rng: np.random.Generator, measured: tuple[float, float], averaged: float
) -> None:
    """Relative errors of exactly 0, averaged variances of 0, systems missing."""
    made = line(rng)
    made = replace(made, mean=np.array([0.0, 0.0]))
    memory = {"credibility.ratio": tensor([averaged, averaged])}
    weight, gradients = weight_and_gradients(made, tensor(measured), memory)
    assert bool(weight.isfinite().all())
    assert bool((weight > 0.0).all())
    assert all(bool(g.isfinite().all()) for g in gradients)


@pytest.mark.parametrize("power", [1.0, 40.0, 400.0])
def test_weights_and_gradients_are_finite_where_a_share_vanishes(
    rng: np.random.Generator, power: float
) -> None:
    """gamma underflows to 0: R would be infinite."""
    made = line(rng)
    values = made.filter.published() | {"credibility.power": tensor(power)}
    leaves = {name: value.requires_grad_() for name, value in values.items()}
    track = run(made.filter, made.log, leaves)
    assert track.record is not None
    assert bool(track.record.noise.isfinite().all())
    total = track.mean.square().mean() + track.covariance.sum()
    gradients = torch.autograd.grad(total, list(leaves.values()))
    assert all(bool(g.isfinite().all()) for g in gradients)


def test_a_system_alone_counts_its_own_information(rng: np.random.Generator) -> None:
    """With one system there the mapping has nothing to share: R as declared."""
    made = line(rng, missing=0.0)
    for absent in (0, 1):
        z = made.log.z.clone()
        z[:, absent] = NAN
        log = replace(made.log, z=z)
        plain = run(replace(made.filter, adaptation=None), log)
        found = run(made.filter, log, {"credibility.power": tensor(2.0)})
        assert_close(found.mean, plain.mean, 1e-12)
        assert_close(found.covariance, plain.covariance, 1e-12)


def test_without_any_measurement_nothing_is_learnt(rng: np.random.Generator) -> None:
    made = line(rng, steps=20)
    z = made.log.z.clone()
    z[12:] = NAN
    log = replace(made.log, z=z)
    values = values_of(POINTS["all"])
    before, after = (run(made.filter, log.rows(0, rows), values).final for rows in (12, 20))
    assert before is not None
    assert after is not None
    for name in ("credibility.ratio", "credibility.drift"):
        assert torch.equal(after.memory[name], before.memory[name])


@pytest.mark.parametrize("case", ["two axes", "sigma per axis"])
def test_the_channels_of_a_system_share_one_weight(rng: np.random.Generator, case: str) -> None:
    made = line(rng, *CASES[case])
    record = run(made.filter, made.log).record
    assert record is not None
    nominal = torch.cat(
        [tensor(s.sigma).square().expand(2) for s in made.filter.sensors]  # type: ignore[attr-defined]
    )
    weight = nominal / record.noise
    for first, second in made.filter.members:
        both = record.present[:, first] & record.present[:, second]
        assert int(both.sum()) > 10
        assert_close(weight[both][:, first], weight[both][:, second], 1e-12)
    apart = weight[:, made.filter.members[0][0]] - weight[:, made.filter.members[1][0]]
    assert float(apart.abs().max()) > 0.1


@pytest.mark.parametrize("case", CASES)
def test_the_total_information_is_conserved(rng: np.random.Generator, case: str) -> None:
    """sum gamma_i I = I, in the metric of the predicted covariance, whatever is measured."""
    made = line(rng, *CASES[case])
    for point in ("published", "power", "floor"):
        record = run(made.filter, made.log, values_of(POINTS[point])).record
        assert record is not None
        nominal = torch.cat(
            [
                tensor(s.sigma).square().expand(made.filter.motion.axes)  # type: ignore[attr-defined]
                for s in made.filter.sensors
            ]
        )
        spread = record.observed.square().sum(-1) * record.present
        assert_close((spread / record.noise).sum(-1), (spread / nominal).sum(-1), 1e-10)


def test_the_mapping_passes_gradcheck_towards_every_parameter(rng: np.random.Generator) -> None:
    made = line(rng, 2, ((3.0, 6.0), 5.0), steps=14)
    log = made.log.rows(0, 5)
    filter = made.filter
    inside = filter.published() | values_of(POINTS["all"])
    del inside["start.sigma"]
    names = list(inside)
    # From the middle of a manoeuvre, so that the drift counts.
    start = run(filter, made.log, inside).final
    assert start is not None
    drifted = {**start.memory, "credibility.drift": tensor([0.9, -0.7])}
    start = start._replace(memory=drifted)

    def posterior(*free: Tensor) -> tuple[Tensor, Tensor]:
        values = {
            name: filter.declarations[name].constraint.physical(u)
            for name, u in zip(names, free, strict=True)
        }
        track = run(filter, log, values, start)
        return track.mean, track.covariance

    free = [
        filter.declarations[name].constraint.free(value).requires_grad_()
        for name, value in inside.items()
    ]
    assert torch.autograd.gradcheck(posterior, free, atol=1e-5, rtol=1e-4, eps=1e-6)
    total = sum(x.square().sum() for x in posterior(*free))
    for name, gradient in zip(names, torch.autograd.grad(total, free), strict=True):  # type: ignore[arg-type]
        assert bool((gradient != 0.0).any()), name


def test_the_credibility_step_of_a_batch_is_each_trajectorys(rng: np.random.Generator) -> None:
    cases = [line(np.random.default_rng(seed), steps=15) for seed in range(3)]
    first = cases[0].log
    assert first.truth is not None
    assert first.start is not None
    log = Log(
        first.channels, torch.stack([c.log.time for c in cases], dim=1),
        torch.stack([c.log.z for c in cases], dim=1),
        start=replace(first.start, mean=tensor(np.stack([c.mean for c in cases]))),
    )  # fmt: skip
    values = values_of(POINTS["all"])
    batch = run(cases[0].filter, log, values)
    for i, case in enumerate(cases):
        assert_close(run(case.filter, case.log, values).mean, batch.mean[:, i], 1e-12)


def mixed(**options: object) -> Filter:
    sensors = (Position(sigma=3.0), TDOA(stations=STATIONS, sigma=3.0))
    systems = ((0, 1), tuple(range(2, 9)))
    return Filter(
        replace(line(np.random.default_rng(0), 2).filter.motion, acceleration=1.0),  # type: ignore[type-var]
        sensors,
        federated=True,
        adaptation=Credibility(systems, 2),
        **options,  # type: ignore[arg-type]
    )


@pytest.mark.parametrize("options", [{}, {"weight": tanh, "iterations": 2}])
def test_systems_of_different_kinds_are_weighed_each_as_one(
    rng: np.random.Generator, options: dict[str, object]
) -> None:
    """A position fix that jumps by 60 m loses its weight; the range differences keep theirs."""
    filter = mixed(**options)
    truth = tensor([500.0, 700.0, 1.0, 14.0])
    constants = filter.prepare()
    state = filter.start(truth, torch.diag(tensor((3.0, 3.0, 1.0, 1.0))))
    weights = []
    for k in range(30):
        truth = truth + tensor([0.1, 1.4, 0.0, 0.0])
        z = torch.cat([s.predict(truth, {}, constants) for s in filter.sensors])
        z = z + 3.0 * tensor(rng.standard_normal(9))
        z[:2] += 60.0 if k >= 15 else 0.0
        state, record = step(filter, constants, state, Measurement(z, tensor(0.1)))
        weights.append(9.0 / record.noise)
        assert_close(weights[-1][2:], weights[-1][2:3].expand(7), 1e-12)
    early, late = weights[14], weights[-1]
    assert float(late[0]) < 0.1 * float(early[0])
    assert float(late[2]) >= 0.9 * float(early[2])
    assert float((state.mean - truth)[:2].norm()) < 10.0


def test_a_common_drift_raises_the_process_noise_and_a_bad_system_does_not() -> None:
    def drift(jumps: tuple[float, float]) -> float:
        made = line(np.random.default_rng(4), missing=0.0, sigmas=(3.0, 3.0))
        z = made.log.truth[:, :1].repeat(1, 2) + tensor(jumps)  # type: ignore[index]
        values = values_of(oracle.Mapping(kappa=0.0, drift_rate=0.1))
        final = run(made.filter, replace(made.log.rows(0, 12), z=z[:12]), values).final
        assert final is not None
        return float(final.memory["credibility.drift"].square() * 1.9 / 0.1)

    assert drift((25.0, 25.0)) > 2.0 * drift((25.0, -25.0))


def test_no_or_one_system_is_refused_and_ideal_has_no_parameter() -> None:
    for systems in ((), ((0, 1),)):
        with pytest.raises(InputError, match="expected two or more"):
            Credibility(systems, 1)
    assert Credibility(((0,), (1,)), 1, ideal=True).parameters == ()
    assert [p.name for p in Credibility(((0,), (1,)), 1).parameters] == [
        f"credibility.{name}" for name in NAMES
    ]


@pytest.mark.parametrize("name", ["ideal.variance", "ideal.error", "ideal.process"])
def test_an_ideal_filter_refuses_a_log_that_does_not_tell(
    rng: np.random.Generator, name: str
) -> None:
    made = line(rng, ideal=True)
    inputs = {key: value for key, value in made.log.inputs.items() if key != name}
    with pytest.raises(InputError, match=f"log: found no input {name}, expected what a clairv"):
        run(made.filter, replace(made.log, inputs=inputs))
