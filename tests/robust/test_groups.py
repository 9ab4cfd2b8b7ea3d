"""Groups of channels: which there are, and how far one is off."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from group_cases import CHANNELS, two_sensors
from helpers import array, assert_close, random_spd, tensor
from hypothesis import given
from hypothesis import strategies as st
from oracles import groups as oracle
from torch import Tensor

from difffilter.errors import InputError
from difffilter.robust.groups import channel_groups, group_rms, normalised_square
from difffilter.weights.registry import huber

PER_SENSOR = (2, 3)
PRESENT = st.lists(st.booleans(), min_size=4, max_size=4)
ALL = (0, 1, 2, 3)


def test_each_scope_gives_its_groups() -> None:
    def groups(scope: object) -> tuple[tuple[int, ...], ...]:
        return channel_groups(scope, CHANNELS, PER_SENSOR)  # type: ignore[arg-type]

    assert groups("channel") == ((0,), (1,), (2,), (3,), (4,))
    assert groups("sensor") == ((0, 1), (2, 3, 4))
    assert groups("all") == ((0, 1, 2, 3, 4),)
    named = {"first": ("d", "a"), "second": ("c",)}
    assert groups(named) == ((3, 0), (2,), (1,), (4,))


@pytest.mark.parametrize(
    ("scope", "message"),
    [
        ("sensors", r"scope: found 'sensors', expected one of channel, sensor, all"),
        ({"g": ("a", "z")}, r"scope\.g: found 'z', expected channels among a, b"),
        ({"g": ("a", "a")}, r"scope\.g: found 'a'.*none twice"),
        ({"g": ("a",), "h": ("b", "a")}, r"scope\.h: found 'a'.*none twice"),
        ({"g": ("a",), "h": ()}, r"scope\.h: found no channel"),
    ],
)
def test_a_scope_that_does_not_fit_is_an_error(scope: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        channel_groups(scope, CHANNELS, PER_SENSOR)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=message):
        _ = two_sensors(scope=scope).grouped


def test_an_unknown_distance_is_an_error() -> None:
    with pytest.raises(InputError, match=r"distance: found 'max', expected rms or mahalanobis"):
        two_sensors(scope="all", distance="max")


def test_mad_with_groups_is_an_error() -> None:
    with pytest.raises(InputError, match="mad: expected scope channel"):
        two_sensors(scope="sensor", weight=huber, iterations=3, mad=True)
    alone = {name: (name,) for name in CHANNELS}
    assert two_sensors(scope=alone, weight=huber, iterations=3, mad=True).grouped is None


@given(present=PRESENT, group=st.sampled_from([(0,), (1, 3), (2, 0, 1), ALL]))
def test_the_group_s_rms_is_over_its_present_channels(
    present: list[bool], group: tuple[int, ...]
) -> None:
    s = np.random.default_rng(5).standard_normal((3, 4))
    found = group_rms(tensor(s), torch.tensor(present).expand(3, 4), group)
    here = [i for i in group if present[i]]
    expected = np.sqrt((s[:, here] ** 2).mean(-1)) if here else np.zeros(3)
    assert_close(found + 1, expected + 1, 1e-14)


def test_the_rms_of_a_missing_or_exact_group_is_zero_with_a_gradient_of_zero() -> None:
    s = tensor([[0.0, 0.0, 1.0], [2.0, 3.0, 1.0]]).requires_grad_()
    present = torch.tensor([[True, True, True], [False, False, True]])
    found = group_rms(s, present, (0, 1))
    (gradient,) = torch.autograd.grad(found.sum(), s)
    assert float(found.abs().max().detach()) < 1e-100
    assert not gradient.any()


def case(noise: str, *batch: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Residual e, deviations Z with two common columns, and r of four channels."""
    rng = np.random.default_rng(9)
    e, z = rng.standard_normal((*batch, 4)), rng.standard_normal((*batch, 4, 6))
    r = {"independent": [0.5, 1.0, 2.0, 0.1], "mixed": [0.5, 0.0, 0.0, 0.1], "full": [0.0] * 4}
    return e, z, np.broadcast_to(np.array(r[noise]), e.shape).copy()


@pytest.mark.parametrize("noise", ["independent", "mixed", "full"])
@pytest.mark.parametrize("group", [(0,), (1, 3), (2, 0, 1), ALL])
@given(present=PRESENT)
def test_the_normalised_square_is_that_of_the_present_channels(
    noise: str, group: tuple[int, ...], present: list[bool]
) -> None:
    e, z, r = case(noise, 3)
    here = torch.tensor(present).expand(3, 4)
    found = array(normalised_square(tensor(e), tensor(z), tensor(r), here, group))
    assert found.shape == (3,)
    for i in range(3):
        known = np.where(present, e[i], np.nan)
        covariance = z[i] @ z[i].T + np.diag(r[i])
        of_group = [list(group)]
        size = oracle.distances(known, covariance, np.diag(covariance), of_group, "mahalanobis")
        assert found[i] == pytest.approx(size[group[0]] ** 2, rel=1e-8)


@pytest.mark.parametrize("noise", ["independent", "mixed", "full"])
def test_without_a_present_channel_the_square_is_zero_with_a_gradient_of_zero(noise: str) -> None:
    leaves = [tensor(x).requires_grad_() for x in case(noise)]
    found = normalised_square(*leaves, torch.zeros(4, dtype=torch.bool), ALL)
    assert float(found.detach()) == 0.0
    for gradient in torch.autograd.grad(found, leaves):
        assert bool((gradient == 0).all())


@pytest.mark.parametrize("noise", ["independent", "mixed", "full"])
@pytest.mark.parametrize("missing", [[], [1], [0, 2]])
def test_gradcheck_of_the_normalised_square(noise: str, missing: list[int]) -> None:
    present = torch.tensor([i not in missing for i in range(4)])
    e, z, r = (tensor(x) for x in case(noise))
    zero = r == 0.0

    def function(e: Tensor, z: Tensor, r: Tensor) -> Tensor:
        return normalised_square(e, z, torch.where(zero, 0.0, r), present, ALL)

    leaves = [x.requires_grad_() for x in (e, z, torch.where(zero, 1.0, r))]
    assert torch.autograd.gradcheck(function, leaves)


def test_without_deviations_the_square_is_of_the_independent_noise_alone() -> None:
    """As of the noise alone of sensors that share none."""
    e, r = tensor([1.0, -3.0, 2.0, 5.0]), tensor([0.5, 1.0, 2.0, 0.1])
    present = torch.tensor([True, True, True, False])
    found = normalised_square(e, torch.zeros(4, 0).double(), r, present, ALL)
    assert float(found) == pytest.approx(2.0 + 9.0 + 2.0)


def test_float32_stays_float32_and_close() -> None:
    cov = random_spd(np.random.default_rng(2), 4)
    z, e = np.linalg.cholesky(cov), np.array([1.0, -2.0, 0.5, 3.0])
    present = torch.ones(4, dtype=torch.bool)
    e32, z32 = tensor(e).float(), tensor(z).float()
    found = normalised_square(e32, z32, torch.ones(4), present, ALL)
    assert found.dtype == torch.float32
    assert float(found) == pytest.approx(e @ np.linalg.inv(cov + np.eye(4)) @ e, rel=1e-4)
