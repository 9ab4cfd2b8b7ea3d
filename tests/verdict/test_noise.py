"""Q and R from truth and from likelihood, what truth says of a log, and clean data."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import tensor

import difffilter as df
from difffilter import ConstantVelocity, Filter, InputError, Log, Position, load_scenario, simulate
from difffilter.comparison.held_out import HeldOut
from difffilter.filters.recipe import Recipe
from difffilter.robust.gate import Gate
from difffilter.scenario.model import tuning_alone
from difffilter.scoring import losses
from difffilter.scoring.metrics import FEW, paired_ratio
from difffilter.scoring.truth import measurement_errors, true_states
from difffilter.verdict.contests import SAMPLE, contenders, contest
from difffilter.verdict.figures_verdict import autocorrelation
from difffilter.verdict.noise_estimates import (
    noise_names,
    plain_filter,
    sample_covariances,
)
from difffilter.verdict.nominal import clean, nominal_toll
from difffilter.weights.registry import WEIGHTS

AIRPORT = load_scenario("airport-mlat-intermittent", {"world.steps": 40})
AT_REST = df.Start(
    torch.zeros(100, 4, dtype=torch.float64), 2.0 * torch.eye(4, dtype=torch.float64), 0.0
)
SMALL = {"trajectories": 6, "validation": 4, "test": 2, "batch": 6, "steps": 2,
         "evaluate_every": 1}  # fmt: skip


def m_ekf() -> Filter:
    system = AIRPORT.system("m-ekf")
    assert isinstance(system, Recipe)
    return system


def walk(count: int, q: float, sigma: float, seed: int = 0) -> Log:
    """A constant-velocity world by NumPy: acceleration q, positions measured with sigma."""
    rng = np.random.default_rng(seed)
    dt, steps = 0.5, 60
    x, v, rows = rng.normal(size=(count, 2)), rng.normal(size=(count, 2)), []
    for _ in range(steps):
        a = q * rng.normal(size=(count, 2))
        x, v = x + dt * v + 0.5 * dt**2 * a, v + dt * a
        rows.append(np.concatenate([x, v], -1))
    truth = np.stack(rows)
    z = truth[..., :2] + sigma * rng.normal(size=(steps, count, 2))
    return Log(
        ("position_1", "position_2"), dt * torch.arange(1.0, steps + 1, dtype=torch.float64),
        tensor(z), tensor(truth), ("x", "y", "vx", "vy"),
    )  # fmt: skip


def plain_position(**changes: object) -> Filter:
    made = Filter(ConstantVelocity(2), (Position(sigma=1.0),))
    tuned = {n: replace(p, tuned=p.noise) for n, p in made.declarations.items()}
    return replace(made, overrides=tuned, **changes)


def test_sample_covariances_recover_the_noise_of_a_world() -> None:
    found = sample_covariances(plain_position(), walk(200, 2.0, 3.0))
    assert float(found["motion.acceleration"]) == pytest.approx(2.0, rel=0.02)
    assert float(found["position.sigma"]) == pytest.approx(3.0, rel=0.02)


def test_sample_covariances_are_numpys() -> None:
    log = walk(5, 2.0, 3.0)
    assert log.truth is not None
    z, truth = log.z.numpy(), log.truth.numpy()
    errors = (z - truth[..., :2]).reshape(-1, 2)
    drawn = (np.diff(truth[..., 2:], axis=0) / 0.5).reshape(-1, 2)
    found = sample_covariances(plain_position(), log)
    assert float(found["position.sigma"]) == pytest.approx(np.sqrt(errors.var(0).mean()), rel=1e-10)
    assert float(found["motion.acceleration"]) == pytest.approx(
        np.sqrt(drawn.var(0).mean()), rel=1e-10
    )
    full = Filter(
        ConstantVelocity(2, acceleration=((1.0, 0.0), (0.0, 1.0))), (Position(sigma=(1.0, 1.0)),)
    )
    full = replace(full, overrides={n: replace(p, tuned=p.noise) for n, p in
                                    full.declarations.items()})  # fmt: skip
    found = sample_covariances(full, log)
    np.testing.assert_allclose(found["position.sigma"].numpy(), errors.std(0), rtol=1e-10)
    np.testing.assert_allclose(
        found["motion.acceleration"].numpy(), np.cov(drawn.T, bias=True), rtol=1e-9
    )


def test_truth_that_never_moves_has_a_least_process_noise() -> None:
    found = sample_covariances(plain_position(), walk(4, 0.0, 3.0))
    assert float(found["motion.acceleration"]) == pytest.approx(1e-3)


def test_the_plain_filter_has_the_same_noise_and_nothing_robust() -> None:
    bare = plain_filter(m_ekf())
    assert (bare.weight.name, bare.iterations, bare.gate) == ("plain", 0, None)
    assert not any(name.startswith("tanh") for name in bare.declarations)
    for name in noise_names(m_ekf()):
        assert bare.declarations[name] == m_ekf().declarations[name]


def test_noise_is_what_scales_q_and_r() -> None:
    assert set(noise_names(m_ekf())) == {"motion.acceleration", "tdoa.sigma"}
    alone = tuning_alone(m_ekf(), ["tdoa.sigma"])
    assert [n for n, p in alone.declarations.items() if p.tuned] == ["tdoa.sigma"]


def test_a_missing_velocity_is_the_central_difference() -> None:
    log = walk(3, 1.0, 1.0)
    assert log.truth is not None
    bare = replace(log, truth=log.truth[..., :2], truth_states=("x", "y"))
    found = true_states(plain_position(), bare).numpy()
    np.testing.assert_allclose(found[..., 2], np.gradient(log.truth[..., 0].numpy(), 0.5, axis=0))
    with pytest.raises(InputError, match="truth: found none"):
        true_states(plain_position(), replace(log, truth=None, truth_states=()))


def test_measurement_errors_are_measured_minus_true() -> None:
    log = simulate(AIRPORT, 3, 1)
    stations = np.asarray(m_ekf().sensors[0].stations, dtype=float)  # type: ignore[attr-defined]
    assert log.truth is not None
    position = log.truth[..., :2].numpy()
    apart = np.linalg.norm(position[..., None, :] - stations[:, :2], axis=-1)
    expected = log.z.numpy() - (apart[..., 1:] - apart[..., :1])
    np.testing.assert_allclose(measurement_errors(m_ekf(), log).numpy(), expected, atol=1e-7)


def test_the_log_density_is_the_joint_normal_one_of_what_is_present() -> None:
    log = simulate(AIRPORT, 2, 1)
    z = log.z.clone()
    z[3:9, 0, 2] = torch.nan
    z[20, 1] = torch.nan
    log = replace(log, z=z)
    bare = plain_filter(m_ekf())
    track = df.run(bare, log)
    record = track.record
    assert record is not None
    total, count = 0.0, 0
    for t in range(log.steps):
        for b in range(2):
            seen = ~np.isnan(z[t, b].numpy())
            deviations = record.observed[t, b].numpy()[seen]
            noise = record.noise.expand_as(record.innovation)[t, b].numpy()
            s = deviations @ deviations.T + np.diag(noise[seen])
            nu = record.innovation[t, b].numpy()[seen]
            own = -0.5 * (nu @ np.linalg.solve(s, nu) + np.linalg.slogdet(2.0 * np.pi * s)[1])
            own = own if seen.any() else 0.0
            assert float(record.log_density[t, b]) == pytest.approx(own, rel=1e-9, abs=1e-12)
            total, count = total - own, count + int(seen.sum())
    loss, _ = losses.total_loss({"normal-likelihood": 1.0}, track, log, losses.LossContext())
    assert float(loss) == pytest.approx(total / count, rel=1e-10)


def test_likelihood_of_the_plain_filter_finds_the_noise_of_a_clean_world() -> None:
    log = walk(100, 2.0, 3.0)
    filter = plain_position()
    context = losses.LossContext()

    def loss(q: float, sigma: float) -> float:
        values = {"motion.acceleration": tensor(q), "position.sigma": tensor(sigma)}
        track = df.run(filter, log, values, AT_REST)
        return float(losses.total_loss({"normal-likelihood": 1.0}, track, log, context)[0])

    best = loss(2.0, 3.0)
    assert all(loss(q, s) > best for q, s in ((1.5, 3.0), (2.6, 3.0), (2.0, 2.6), (2.0, 3.4)))


def test_the_nominal_toll_is_the_integral_over_a_normal_density() -> None:
    filter = plain_position(weight=WEIGHTS["huber"])
    grid = np.linspace(-9.0, 9.0, 200_001)
    density = np.exp(-0.5 * grid**2) / math.sqrt(2.0 * math.pi)
    k = float(filter.published()["huber.k"])
    weight = np.minimum(1.0, k / np.maximum(np.abs(grid), 1e-12))
    found = nominal_toll(filter, filter.published())
    assert found is not None
    assert found.weight == pytest.approx(np.trapezoid(weight * density, grid), abs=1e-4)
    gated = plain_position(gate=Gate("reject", 0.05))
    found = nominal_toll(gated, gated.published())
    assert found is not None
    assert found.rejected == pytest.approx(0.05, abs=2e-4)
    assert nominal_toll(plain_position(scope="all"), {}) is None


def test_clean_data_have_no_faults() -> None:
    held = HeldOut(AIRPORT, m_ekf(), simulate(AIRPORT, 4, 1))
    other = clean(held, 6, 2)
    assert other is not None
    assert other.log.trajectories == 6
    assert float(measurement_errors(m_ekf(), other.log).abs().max()) < 6.0 * 3.0
    assert float(measurement_errors(m_ekf(), held.log).abs().max()) > 6.0 * 3.0


def test_one_long_run_has_an_interval_from_blocks_and_many_runs_from_runs() -> None:
    rng = np.random.default_rng(1)
    base = tensor(rng.exponential(size=(400, 1)))
    other = tensor(0.5 * rng.exponential(size=(400, 1)))
    rows = torch.ones(400, 1, dtype=torch.bool)
    ratio, low, high = paired_ratio(other, base, rows)
    assert low < ratio < high
    assert ratio == pytest.approx(float((other.sum() / base.sum()).sqrt()))
    blocks = paired_ratio(
        other.reshape(FEW, -1).T.contiguous(), base.reshape(FEW, -1).T.contiguous(),
        torch.ones(400 // FEW, FEW, dtype=torch.bool),
    )  # fmt: skip
    assert (ratio, low, high) == pytest.approx(blocks, rel=1e-12)


def test_white_innovations_have_no_autocorrelation_and_coloured_ones_have() -> None:
    log = walk(100, 2.0, 3.0)
    start = AT_REST
    right = {"motion.acceleration": tensor(2.0), "position.sigma": tensor(3.0)}
    found, band = autocorrelation(df.run(plain_position(), log, right, start))
    assert max(map(abs, found)) < 3.0 * band
    slow = {"motion.acceleration": tensor(0.2), "position.sigma": tensor(3.0)}
    found, band = autocorrelation(df.run(plain_position(), log, slow, start))
    assert found[0] > 10.0 * band


def test_a_contest_gives_every_method_the_budget_of_the_gradient() -> None:
    settings = replace(AIRPORT.tuning, **SMALL)
    held = HeldOut(AIRPORT, m_ekf(), simulate(AIRPORT, 4, 1))
    courses = list(contest(AIRPORT, m_ekf(), settings, held, seeds=(0,), methods=("random",)))
    assert [course.method for course in courses] == ["adam", "random"]
    gradient, random = courses
    # The optimiser asks for six runs of seven at a time, the search for ten points of six.
    assert gradient.runs[-1] <= random.runs[-1] <= gradient.runs[-1] + 11 * 6
    assert gradient.loss[0] == random.loss[0]
    assert gradient.at(runs=0.0) == 0
    assert gradient.at() == len(gradient.runs) - 1


def test_noise_alone_leaves_everything_else_as_published() -> None:
    settings = replace(AIRPORT.tuning, **SMALL)
    held = HeldOut(AIRPORT, m_ekf(), simulate(AIRPORT, 4, 1))
    published = m_ekf().published()
    tuned = {**published, "tdoa.sigma": tensor(5.0)}
    found = contenders(AIRPORT, m_ekf(), settings, held, tuned)
    assert [c.name for c in found][:2] == ["published", SAMPLE]
    assert found[-1].values is tuned
    for contender in found[1:4]:
        assert contender.name.startswith("Q and R")
        for name in set(published) - set(noise_names(m_ekf())):
            torch.testing.assert_close(contender.values[name], published[name], rtol=0, atol=0)
    rest = found[4].values
    for name in noise_names(m_ekf()):
        torch.testing.assert_close(rest[name], published[name], rtol=0, atol=0)
