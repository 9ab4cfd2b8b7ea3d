"""The manoeuvre scenes against a reference's table; the claims can hold and can fail."""

from __future__ import annotations

from types import ModuleType

import pytest
import torch
from fusion_cases import SCENES, estimated, scene
from torch import Tensor

from training.manoeuvre import claims, tables

#: Computed independently, of 200 runs: mean RMSE in m of x and y, scene 1 then scene 2.
TABLE = {
    "srckf": (17.7, 10.1, 99.3, 94.0),
    "robust-srckf": (29.7, 15.1, 30.0, 15.1),
    "lcasrckf": (7.2, 6.4, 73.9, 73.2),
    "stf-srckf": (6.3, 5.6, 72.9, 72.5),
    "rmckf": (8.7, 8.3, 74.6, 74.2),
    "fusion": (5.2, 4.6, 5.4, 4.7),
}
RUNS = 40


def squared(name: str, system: str) -> Tensor:
    """Squared errors (T, B, 2)."""
    _, log = scene(name, RUNS)
    assert log.truth is not None
    return (estimated(name, system, RUNS).mean[..., :2] - log.truth[..., :2]).square()


@pytest.mark.parametrize("system", TABLE)
def test_the_mean_errors_are_those_of_the_reference(system: str) -> None:
    found = [float(x) for n in SCENES for x in squared(n, system).mean(1).sqrt().mean(0)]
    assert found == pytest.approx(TABLE[system], rel=0.12)


def test_on_the_pooled_measurement_one_filter_is_as_good_but_for_bad_measurements() -> None:
    one, two = (
        {n: float(squared(s, n).mean(1).sqrt().mean()) for n in ("pooled-lcasrckf", "fusion")}
        for s in SCENES
    )
    assert one["pooled-lcasrckf"] == pytest.approx(one["fusion"], rel=0.05)
    assert two["pooled-lcasrckf"] == pytest.approx(71.0, rel=0.12)


@pytest.fixture
def training() -> tuple[ModuleType, ModuleType]:
    """The experiment's modules of claims and tables."""
    return claims, tables


#: RMSE of each system in m while all is well, in turns, and at bad measurements of scene 2.
LIKE_THE_PAPER = {
    "srckf": (4.0, 30.0, 200.0),
    "robust-srckf": (4.0, 40.0, 30.0),
    "lcasrckf": (4.4, 9.0, 300.0),
    "stf-srckf": (4.4, 8.0, 290.0),
    "rmckf": (4.5, 10.0, 310.0),
    "fusion": (3.0, 5.0, 12.0),
    "pooled-lcasrckf": (3.0, 5.0, 300.0),
    "pooled-stf-srckf": (2.9, 4.8, 300.0),
}


def made_up(tables: ModuleType, levels: dict[str, tuple[float, ...]], second: bool) -> dict:
    scenes = {}
    for name, (calm, turning, bad) in levels.items():
        curve = torch.full((150,), calm, dtype=torch.float64)
        curve[30:60] = curve[80:120] = turning
        if second and name not in ("fusion", "robust-srckf"):
            curve[[79, 104]] = bad
            curve[9:12] = 10.0 * bad
        elif second:
            curve[104:107] = bad
        scenes[name] = tables.Errors(curve.square()[:, None, None].expand(150, 6, 2), 1.0)
    return scenes


#: What of the levels is changed so that the claim says no: system, index, value.
SPOILED = {
    "fusion_lowest": ("fusion", 1, 60.0),
    "slightly_worse_while_right": ("rmckf", 0, 6.0),
    "better_in_turns": ("lcasrckf", 1, 25.0),
    "rmckf_worse": ("rmckf", 1, 8.5),
    "all_jump": ("lcasrckf", 2, 10.0),
    "adaptive_jump_higher": ("rmckf", 2, 150.0),
    "fusion_flat": ("fusion", 2, 90.0),
    "pooled_equal": ("pooled-lcasrckf", 1, 9.0),
    "pooled_fail": ("pooled-stf-srckf", 2, 5.0),
}


@pytest.mark.parametrize("claim", SPOILED)
def test_a_claim_holds_for_errors_like_the_papers_and_fails_for_others(
    training: tuple[ModuleType, ModuleType], claim: str
) -> None:
    claims, tables = training
    check = getattr(claims, claim)
    system, index, value = SPOILED[claim]
    spoiled = [*LIKE_THE_PAPER[system]]
    spoiled[index] = value
    verdicts = []
    for levels in (LIKE_THE_PAPER, LIKE_THE_PAPER | {system: tuple(spoiled)}):
        one, two = (made_up(tables, levels, second) for second in (False, True))
        held, numbers = check(one, two)
        assert isinstance(held, bool)
        assert numbers
        assert all(isinstance(number, float) for number in numbers.values())
        verdicts.append(held)
    assert verdicts == [True, False]


def test_every_claim_of_the_experiment_is_tried(training: tuple[ModuleType, ModuleType]) -> None:
    claims, _ = training
    assert {check.__name__ for check in claims.CLAIMS.values()} == set(SPOILED)


def test_errors_are_averaged_over_runs_then_over_time(
    training: tuple[ModuleType, ModuleType],
) -> None:
    _, tables = training
    squares = torch.tensor(
        [[[1.0, 4.0], [17.0, 4.0]], [[0.0, 0.0], [0.0, 32.0]]], dtype=torch.float64
    )
    errors = tables.Errors(squares, 1.0)
    assert errors.axes == pytest.approx([1.5, 3.0])
    assert errors.mean == pytest.approx(2.25)
    assert errors.rms == pytest.approx((58.0 / 4.0) ** 0.5)
    ratio, low, high = tables.gain(tables.Errors(squares / 4.0, 1.0), errors, 20)
    assert (ratio, low, high) == pytest.approx((0.5, 0.5, 0.5))
