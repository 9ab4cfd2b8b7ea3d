"""Rows in any order: the belief is that of the sorted log."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from difffilter import ConstantVelocity, Filter, Log, Position, Start, Tracker, huber, run
from difffilter.errors import InputError

D = torch.float64
COUNT = 12
FILTER = Filter(ConstantVelocity(), (Position(sigma=1.0),), huber)
TIME = torch.tensor([0.0, 0.1, 0.5, 1.0, 1.7, 2.0, 2.1, 3.0, 4.5, 5.0, 5.2, 6.0], dtype=D)
Z = torch.randn(COUNT, 2, generator=torch.Generator().manual_seed(0), dtype=D) * 3.0
Z[4, 1] = torch.nan
START = Start(torch.zeros(4, dtype=D), torch.eye(4, dtype=D), -1.0)
SORTED = run(FILTER, Log(FILTER.channels, TIME, Z), start=START, engine="torch")


def tracker(history: float | None, engine: str = "torch") -> Tracker:
    return Tracker(
        FILTER, [0.0] * 4, torch.eye(4, dtype=D), engine=engine, history=history, time=-1.0
    )


@settings(max_examples=60, deadline=None)
@given(st.permutations(range(COUNT)))
def test_any_order_is_the_sorted_run(order: list[int]) -> None:
    one = tracker(100.0)
    for k in order:
        assert one.step(Z[k], time=float(TIME[k])) is not None
    assert (one.steps, one.dropped) == (COUNT, 0)
    torch.testing.assert_close(one.belief.mean, SORTED.mean[-1], rtol=1e-12, atol=1e-12)
    assert SORTED.final is not None
    torch.testing.assert_close(
        one.belief.deviations, SORTED.final.deviations, rtol=1e-12, atol=1e-12
    )


def test_the_compiled_step_goes_back_too() -> None:
    one = tracker(100.0, "fused")
    for k in (3, 0, 1, 2, *range(5, COUNT), 4):
        one.step(Z[k], time=float(TIME[k]))
    torch.testing.assert_close(one.belief.mean, SORTED.mean[-1], rtol=1e-9, atol=1e-9)


def test_what_is_older_than_the_history_is_dropped_and_told() -> None:
    one = tracker(1.0)
    rest = [k for k in range(COUNT) if k != 3]
    for k in rest:
        one.step(Z[k], time=float(TIME[k]))
    before = one.belief.mean.clone()
    assert one.step(Z[3], time=float(TIME[3])) is None
    assert one.dropped == 1
    assert torch.equal(one.belief.mean, before)
    log = Log(FILTER.channels, TIME[rest], Z[rest])
    without = run(FILTER, log, start=START, engine="torch")
    torch.testing.assert_close(before, without.mean[-1], rtol=1e-12, atol=1e-12)
    assert one._history is not None
    assert len(one._history._rows) == 3  # at 5, 5.2 and 6 s


def test_a_wrong_row_changes_nothing() -> None:
    one = tracker(10.0)
    one.step(Z[0], time=0.0)
    one.step(Z[2], time=0.5)
    before = one.belief.mean.clone()
    with pytest.raises(InputError, match="z"):
        one.step([1.0, 2.0, 3.0], time=0.2)
    with pytest.raises(InputError, match="before the start"):
        one.step(Z[0], time=-2.0)
    with pytest.raises(InputError, match="expected time with history"):
        one.step(Z[0], 1.0)
    with pytest.raises(InputError, match="history"):
        one.feed(Z, TIME)
    with pytest.raises(InputError, match="history: found -1"):
        tracker(-1.0)
    assert torch.equal(one.belief.mean, before)
    assert one.steps == 2
