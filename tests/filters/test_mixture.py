"""Interacting multiple models: against Blom and Bar-Shalom's equations, and what they imply."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from helpers import array, assert_close, tensor
from oracles.imm import Mode, imm

from difffilter import (
    ConstantVelocity,
    CoordinatedTurn,
    Filter,
    InputError,
    Log,
    Position,
    Start,
    huber,
    igg3,
    run,
)
from difffilter.engine.build import compiler
from difffilter.filters.mixture import PROBABILITY, Mixture
from difffilter.robust.gate import Gate

ENGINES = ["torch", pytest.param("fused", marks=pytest.mark.skipif(not compiler(), reason="cc"))]
P0 = np.diag([25.0, 25.0, 4.0, 4.0])


def radar(sigma: float = 5.0, **options: object) -> tuple[Position, ...]:
    return (Position(channels=("x", "y"), sigma=sigma, **options),)  # type: ignore[arg-type]


def three(weight: object = None) -> Mixture:
    options = {} if weight is None else {"weight": weight}
    modes = {
        "calm": Filter(ConstantVelocity(2, acceleration=0.2), radar(), **options),  # type: ignore[arg-type]
        "left": Filter(CoordinatedTurn(2, acceleration=0.2, turn_rate=0.1), radar(), **options),  # type: ignore[arg-type]
        "noisy": Filter(ConstantVelocity(2, acceleration=4.0), radar(9.0), **options),  # type: ignore[arg-type]
    }
    return Mixture(modes, rate=0.08, share=(0.6, 0.3, 0.1))


def log(steps: int = 60, gaps: float = 0.2, seed: int = 3) -> Log:
    rng = np.random.default_rng(seed)
    time = np.cumsum(rng.uniform(0.2, 2.0, steps))
    heading = np.cumsum(np.where((time > 20) & (time < 40), 0.1, 0.0) * np.diff(time, prepend=0.0))
    velocity = 12.0 * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    path = np.cumsum(velocity * np.diff(time, prepend=0.0)[:, None], axis=0)
    z = path + 5.0 * rng.normal(size=path.shape)
    z[rng.random(z.shape) < gaps] = np.nan
    return Log(("x", "y"), tensor(time), tensor(z))


def start() -> Start:
    return Start(tensor([0.0, 0.0, 12.0, 0.0]), tensor(P0), 0.0)


def turn(w: float, dt: float) -> np.ndarray:
    s, c = np.sin(w * dt), np.cos(w * dt)
    f = np.eye(4)
    f[:2, 2:] = [[s / w, -(1 - c) / w], [(1 - c) / w, s / w]]
    f[2:, 2:] = [[c, -s], [s, c]]
    return f


def straight(dt: float) -> np.ndarray:
    f = np.eye(4)
    f[0, 2] = f[1, 3] = dt
    return f


def noise(level: float, dt: float) -> np.ndarray:
    g = np.concatenate([0.5 * dt**2 * np.eye(2), dt * np.eye(2)])
    return level**2 * g @ g.T


def test_equal_to_the_textbook_over_a_whole_log() -> None:
    mixture, given = three(), log()
    h = np.eye(2, 4)
    modes = (
        Mode(straight, lambda dt: noise(0.2, dt), h, 25.0 * np.eye(2)),
        Mode(lambda dt: turn(0.1, dt), lambda dt: noise(0.2, dt), h, 25.0 * np.eye(2)),
        Mode(straight, lambda dt: noise(4.0, dt), h, 81.0 * np.eye(2)),
    )
    share = np.array([0.6, 0.3, 0.1])
    means, covs, probability = imm(
        modes, 0.08, share, array(given.time), array(given.z), array(start().mean), P0, share
    )
    track = run(mixture, given, start=start(), engine="torch")
    assert_close(track.mean, means, 1e-9)
    assert_close(track.covariance, covs, 1e-9)
    assert track.final is not None
    assert_close(track.final.memory[PROBABILITY], probability[-1], 1e-9)


@pytest.mark.parametrize("count", [1, 3])
def test_equal_modes_are_the_plain_filter(count: int) -> None:
    filter = Filter(ConstantVelocity(2, acceleration=1.0), radar(), huber, gate=Gate("reject"))
    mixture = Mixture({f"m{i}": filter for i in range(count)}, rate=0.3)
    given = log()
    expected = run(filter, given, start=start(), engine="torch")
    found = run(mixture, given, start=start(), engine="torch")
    assert_close(found.mean, expected.mean, 1e-12)
    assert_close(found.covariance, expected.covariance, 1e-12)
    assert expected.record is not None
    assert found.record is not None
    for name in ("innovation", "weight", "gate", "noise", "standardised"):
        assert_close(getattr(found.record, name), getattr(expected.record, name), 1e-11)
    assert_close(found.record.nis, expected.record.nis, 1e-10)


@pytest.mark.parametrize("size", [1e2, 1e6, 1e9])
@pytest.mark.parametrize("weight", [None, igg3])
def test_probabilities_are_sound_at_any_innovation(size: float, weight: object) -> None:
    mixture, given = three(weight), log(20, 0.0)
    z = given.z.clone()
    z[10] += size * 5.0
    track = run(mixture, replace(given, z=z), start=start(), engine="torch")
    assert track.final is not None
    probability = track.final.memory[PROBABILITY]
    assert bool(torch.isfinite(track.mean).all())
    assert float(probability.sum()) == pytest.approx(1.0, abs=1e-12)
    assert bool(((probability >= 0) & (probability <= 1)).all())


def test_a_row_that_every_mode_rejects_says_nothing_of_the_mode() -> None:
    mixture, given = three(igg3), log(12, 0.0)
    before = run(mixture, given.rows(0, 10), start=start(), engine="torch").final
    assert before is not None
    z = given.z.clone()
    z[10] += 1e4
    after = run(mixture, replace(given, z=z).rows(0, 11), start=start(), engine="torch").final
    assert after is not None
    dt = float(given.time[10] - given.time[9])
    kept, share = np.exp(-0.08 * dt), np.array([0.6, 0.3, 0.1])
    expected = kept * array(before.memory[PROBABILITY]) + (1.0 - kept) * share
    assert_close(after.memory[PROBABILITY], expected, 1e-12)


def test_a_mode_does_not_win_by_rejecting() -> None:
    """The tight mode rejects what the wide one believes: the wide one gains."""
    tight = Filter(ConstantVelocity(2, acceleration=0.01), radar(1.0), igg3)
    wide = Filter(ConstantVelocity(2, acceleration=0.01), radar(30.0), igg3)
    mixture = Mixture({"tight": tight, "wide": wide}, rate=0.01)
    time = torch.arange(1.0, 11.0).double()
    z = torch.stack([12.0 * time, 0.0 * time], -1)
    z[5:] += torch.tensor([40.0, -40.0], dtype=torch.float64)
    track = run(mixture, Log(("x", "y"), time, z), start=start(), engine="torch")
    assert track.final is not None
    assert float(track.final.memory[PROBABILITY][1]) > 0.99


def test_gradients_towards_every_value() -> None:
    mixture, given = three(huber), log(8)
    values = mixture.published()
    names = ["calm.motion.acceleration", "left.motion.turn_rate", "modes.rate", "modes.share"]

    def loss(*found: torch.Tensor) -> torch.Tensor:
        changed = values | dict(zip(names, found, strict=True))
        track = run(mixture, given, changed, start=start(), engine="torch")
        return track.mean.square().mean() + track.covariance.mean()

    shares = values["modes.share"]
    inputs = [values[n].clone().requires_grad_() for n in names[:-1]]

    def free(*found: torch.Tensor) -> torch.Tensor:
        last = torch.stack([found[-1], shares[1], 1.0 - shares[1] - found[-1]])
        return loss(*found[:-1], last)

    assert torch.autograd.gradcheck(free, (*inputs, shares[0].clone().requires_grad_()))


def test_parameters_are_shared_or_each_modes_own() -> None:
    declared = three().declarations
    assert set(declared) == {
        "calm.motion.acceleration", "left.motion.acceleration", "left.motion.turn_rate",
        "noisy.motion.acceleration", "calm.position.sigma", "left.position.sigma",
        "noisy.position.sigma", "position.bias", "modes.rate", "modes.share",
    }  # fmt: skip


def test_modes_that_do_not_fit_are_input_errors() -> None:
    calm = Filter(ConstantVelocity(2), radar())
    flat = Filter(ConstantVelocity(1), (Position(channels=("x",), axes=1),))
    with pytest.raises(InputError, match=r"modes\.flat: found states x, vx"):
        Mixture({"calm": calm, "flat": flat})
    with pytest.raises(InputError, match="modes: found none"):
        Mixture({})
    with pytest.raises(InputError, match=r"modes\.share: found 3 numbers, expected 1"):
        Mixture({"calm": calm}, share=(0.2, 0.3, 0.5))
    with pytest.raises(InputError, match="modes: found name"):
        Mixture({"../x": calm})


@pytest.mark.parametrize("engine", ENGINES)
def test_the_record_holds_the_probabilities_of_every_row(engine: str) -> None:
    mixture, given = three(igg3), log(20)
    track = run(mixture, given, start=start(), engine=engine)
    assert track.modes == ("calm", "left", "noisy")
    assert track.record is not None
    assert track.final is not None
    assert track.record.modes.shape == (20, 3)
    assert_close(track.record.modes.sum(-1), np.ones(20), 1e-12)
    assert_close(track.record.modes[-1], array(track.final.memory[PROBABILITY]), 1e-12)
    before = run(mixture, given.rows(0, 12), start=start(), engine="torch")
    assert before.final is not None
    assert_close(track.record.modes[11], array(before.final.memory[PROBABILITY]), 1e-9)


def test_a_filter_has_no_modes() -> None:
    filter = Filter(ConstantVelocity(2), radar())
    track = run(filter, log(3), start=start(), engine="torch")
    assert track.modes == ()
    assert track.record is not None
    assert track.record.modes.shape == (3, 0)
