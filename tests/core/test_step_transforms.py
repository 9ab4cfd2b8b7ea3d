"""The step under differentiation, vmap and tracing, in float32, and over a long run."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from helpers import (
    STATIONS,
    assert_close,
    number,
    plane_belief,
    predicted_z,
    run_steps,
    tdoa_filter,
    tensor,
)
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from difffilter.core.beliefs import Belief, Measurement, belief
from difffilter.filters.filter import Filter
from difffilter.filters.stepping import step
from difffilter.motions.blocks import ConstantVelocity
from difffilter.parameters.values import Constants
from difffilter.robust.gate import Gate
from difffilter.robust.recovery import Recovery
from difffilter.sensors.builtin import TDOA, Position
from difffilter.sensors.sensor import FunctionSensor
from difffilter.weights.registry import barron, danish, huber, igg3, student_t, tanh, tukey, welsch

NAN = torch.nan
INNOVATION = tensor([2.0, -4.0, 40.0, 1.0, 5.5, -9.0, 14.0])


def user_ranges(state: Tensor, inputs: object, values: object) -> Tensor:
    apart = state[..., None, :2] - tensor(STATIONS[:7])
    return apart.square().sum(-1).sqrt()


def recipes() -> dict[str, Filter]:
    user = FunctionSensor(tuple("abcdefg"), user_ranges, 3.0)
    common = TDOA(stations=STATIONS, sigma=3.0, common_sigma=2.0)
    full = TDOA(stations=STATIONS, sigma=((np.eye(7) + 0.5) * 9).tolist())
    return {
        "plain": tdoa_filter(),
        "igg3": tdoa_filter(weight=igg3),
        "gated": tdoa_filter(weight=huber, gate=Gate("reweigh")),
        "common noise": tdoa_filter(sensor=common, weight=huber),
        "full noise": tdoa_filter(sensor=full, weight=igg3),
        "m-ekf": tdoa_filter(weight=tanh, iterations=3),
        "m-ekf all rows": tdoa_filter(weight=tanh, iterations=3, weigh_prior=True),
        "m-ekf MAD": tdoa_filter(weight=huber, iterations=2, weigh_prior=True, mad=True),
        "user's sensor": tdoa_filter(sensor=user, weight=huber),
        "sensor's rms": tdoa_filter(sensor=full, weight=danish, scope="all", gate=Gate("reweigh")),
        "groups": tdoa_filter(
            sensor=common,
            weight=barron,
            scope={"first": common.channels[:3], "second": common.channels[4:]},
            distance="mahalanobis",
            gate=Gate("inflate"),
        ),
        "m-ekf of groups": tdoa_filter(
            sensor=full, weight=student_t, scope="all", distance="mahalanobis", iterations=2
        ),
        "widen": tdoa_filter(weight=welsch, gate=Gate("reject"), recovery=Recovery("widen")),
        "inflate": tdoa_filter(weight=tukey, iterations=2, recovery=Recovery("inflate", 1.0)),
    }


RECIPES = recipes()


def setting(filter: Filter, rng: np.random.Generator) -> tuple[Belief, Tensor]:
    """A belief and a measurement with an outlier and a missing channel."""
    state = plane_belief(rng)
    z = predicted_z(filter, state, 0.5, filter.prepare()) + INNOVATION
    z[4] = NAN
    return state, z


def outputs(
    filter: Filter, constants: Constants, mean: Tensor, deviations: Tensor, z: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    start = filter.start(mean, deviations)
    after, record = step(filter, constants, start, Measurement(z, tensor(0.5)))
    return after.mean, after.covariance, record.weight


@pytest.mark.parametrize("name", list(RECIPES))
def test_the_whole_step_passes_gradcheck_towards_every_parameter(
    rng: np.random.Generator, name: str
) -> None:
    filter = RECIPES[name]
    state, z = setting(filter, rng)
    names = list(filter.declarations)
    free = [
        filter.declarations[n].constraint.free(v).requires_grad_()
        for n, v in filter.published().items()
    ]

    def posterior(*free: Tensor) -> tuple[Tensor, ...]:
        values = {
            n: filter.declarations[n].constraint.physical(u)
            for n, u in zip(names, free, strict=True)
        }
        constants = filter.prepare(values, temperature=0.5)
        return outputs(filter, constants, *state[:2], z)  # type: ignore[arg-type]

    assert torch.autograd.gradcheck(posterior, free, atol=1e-5, rtol=1e-4, eps=1e-5)


@pytest.mark.parametrize("name", list(RECIPES))
def test_the_step_is_traced_once_and_holds_for_other_numbers(
    rng: np.random.Generator, name: str
) -> None:
    filter = RECIPES[name]
    constants = filter.prepare()
    state, z = setting(filter, rng)

    def posterior(mean: Tensor, deviations: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        return outputs(filter, constants, mean, deviations, z)

    traced = make_fx(posterior)(state.mean, state.deviations, z)
    other, other_z = setting(filter, rng)
    other_z = other_z.roll(2)  # another channel is missing, others are outliers
    inputs = (other.mean, other.deviations, other_z)
    for found, expected in zip(traced(*inputs), posterior(*inputs), strict=True):
        assert_close(found, expected, 1e-13)


@pytest.mark.parametrize("name", list(RECIPES))
def test_vmap_of_the_step_is_the_batched_step(rng: np.random.Generator, name: str) -> None:
    filter = RECIPES[name]
    constants = filter.prepare()
    settings = [setting(filter, rng) for _ in range(3)]
    mean = torch.stack([state.mean for state, _ in settings])
    deviations = torch.stack([state.deviations for state, _ in settings])
    z = torch.stack([z for _, z in settings])
    inputs = (mean, deviations, z)
    found = torch.func.vmap(lambda *x: outputs(filter, constants, *x))(*inputs)
    for a, b in zip(found, outputs(filter, constants, *inputs), strict=True):
        assert_close(a, b, 1e-13)


@pytest.mark.parametrize("name", list(RECIPES))
def test_forward_mode_through_the_step_equals_reverse_mode(
    rng: np.random.Generator, name: str
) -> None:
    filter = RECIPES[name]
    state, z = setting(filter, rng)
    key = next(n for n in filter.declarations if n.endswith(".sigma"))
    value = filter.published()[key]

    def total(value: Tensor) -> Tensor:
        constants = filter.prepare({key: value}, temperature=0.5)
        mean, covariance, weight = outputs(filter, constants, *state[:2], z)
        return mean.sum() + covariance.square().sum() + weight.sum()

    _, along = torch.func.jvp(total, (value,), (value,))
    leaf = value.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(total(leaf), leaf)
    assert number(along) == pytest.approx(number((gradient * value).sum()), rel=1e-9)


@pytest.mark.parametrize("name", list(RECIPES))
def test_float32_gives_the_float64_result_in_float32(rng: np.random.Generator, name: str) -> None:
    filter = RECIPES[name]
    if name == "user's sensor":
        user = FunctionSensor(tuple("abcdefg"), lambda x, i, v: 2 * x[..., [0, 1, 2, 3, 0, 1, 2]])
        filter = tdoa_filter(sensor=user, weight=huber)
    state, z = setting(filter, rng)
    expected = outputs(filter, filter.prepare(), *state[:2], z)
    single = filter.prepare(filter.published(torch.float32))
    after, record = step(
        filter,
        single,
        filter.start(state.mean.float(), state.deviations.float()),
        Measurement(z.float(), torch.tensor(0.5)),
    )
    for found, reference in zip(
        (after.mean, after.covariance, record.weight), expected, strict=True
    ):
        assert found.dtype == torch.float32
        assert_close(found.double(), reference, 1e-3)


def test_the_covariance_stays_semidefinite_in_float32_over_10_000_steps() -> None:
    filter = Filter(ConstantVelocity(1, acceleration=1e-3), (Position(axes=1, sigma=1e-2),))
    start = (torch.zeros(1, 2), torch.diag(torch.tensor([1e6, 1e6])).expand(1, 2, 2))
    generator = torch.Generator().manual_seed(1)
    z = torch.randn(10_000, 1, 1, generator=generator, dtype=torch.float64)
    covariances = {}
    for dtype in (torch.float32, torch.float64):
        constants = filter.prepare(filter.published(dtype))
        state = belief(*(x.to(dtype) for x in start))
        steps = 10_000 if dtype == torch.float32 else 2_000
        dt = torch.full((steps,), 0.1, dtype=dtype)
        beliefs, _ = run_steps(filter, constants, state, (1e-2 * z[:steps]).to(dtype), dt)
        covariances[dtype] = torch.cat([b.covariance.double() for b in beliefs])
    single, double = covariances[torch.float32], covariances[torch.float64]
    assert bool(torch.isfinite(single).all())
    assert bool((torch.linalg.eigvalsh(single)[:, 0] >= -1e-7 * single.amax((-1, -2))).all())
    assert bool((single.diagonal(dim1=-2, dim2=-1) > 0).all())
    # Both have settled long before step 2,000, on the same covariance.
    assert_close(single[-1], double[-1], 1e-3)


def test_a_belief_is_never_written_to(rng: np.random.Generator) -> None:
    for filter in RECIPES.values():
        state, z = setting(filter, rng)
        copies = [x.clone() for x in (state.mean, state.deviations, z)]
        outputs(filter, filter.prepare(), *state[:2], z)
        for x, copy in zip((state.mean, state.deviations, z), copies, strict=True):
            torch.testing.assert_close(x, copy, rtol=0, atol=0, equal_nan=True)
