"""Logs in memory: shapes, intervals, selections, stacks of logs of different lengths."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers import tensor

from difffilter.errors import InputError
from difffilter.logs.log import Log, Start, stack_logs

NAN = float("nan")


def make(steps: int, *batch: int, offset: float = 0.0) -> Log:
    """Numbers that are all different, with truth and one input per row."""
    z = offset + torch.arange(2.0 * steps * math.prod(batch)).double().reshape(steps, *batch, 2)
    truth = 1000.0 + z
    inputs = {"wind": 0.5 * z}
    return Log(("a", "b"), torch.arange(steps).double(), z, truth, ("x", "y"), inputs)


def test_counts_rows_trajectories_and_presence() -> None:
    log = make(4, 3)
    z = log.z.clone()
    z[1, 2, 0] = z[2, 1, 0] = z[2, 1, 1] = NAN
    log = replace(log, z=z)
    assert (log.steps, log.trajectories, make(4).trajectories) == (4, 3, 1)
    assert log.present.sum() == 4 * 3 * 2 - 3
    assert (~log.measured).nonzero().tolist() == [[2, 1]]


SPOILED: dict[str, tuple[Callable[[Log], object], str]] = {
    "channels": (lambda log: replace(log, channels=("a",)), "2 columns.*expected 1 channels"),
    "infinite": (lambda log: replace(log, z=log.z * torch.inf), "infinite measurement"),
    "time too short": (lambda log: replace(log, time=log.time[:2]), r"times of shape \[2\]"),
    "time of a batch": (lambda log: replace(log, time=torch.zeros(4, 2)), r"shape \[4, 2\]"),
    "time missing": (lambda log: replace(log, time=log.time * NAN), "time that is not finite"),
    "truth states": (lambda log: replace(log, truth_states=("x",)), r"truth of shape \[4, 3, 2\]"),
    "truth rows": (
        lambda log: replace(log, truth=log.truth[:3] if log.truth is not None else None),
        r"truth of shape \[3, 3, 2\]",
    ),
    "input rows": (
        lambda log: replace(log, inputs={"wind": torch.zeros(3, 3)}),
        r"input wind of shape \[3, 3\], expected 4 rows",
    ),
    "no time": (lambda log: Log(("a",), tensor(0.0), tensor([1.0])), "dimension of time"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_contents_that_do_not_fit_together_are_refused(name: str) -> None:
    spoil, message = SPOILED[name]
    with pytest.raises(InputError, match=message):
        spoil(make(4, 3))


def test_intervals_count_from_the_start_time_or_from_the_first_row() -> None:
    log = replace(make(4), time=tensor([1.0, 1.5, 1.5, 4.0]))
    assert log.intervals().tolist() == [0.0, 0.5, 0.0, 2.5]
    assert log.intervals(0.25).tolist() == [0.75, 0.5, 0.0, 2.5]


def test_intervals_of_each_trajectory_by_itself() -> None:
    time = tensor([[0.0, 1.0], [1.0, 1.0], [3.0, 2.0]])
    log = replace(make(3, 2), time=time)
    assert log.intervals().tolist() == [[0.0, 0.0], [1.0, 0.0], [2.0, 1.0]]
    assert log.intervals(-1.0).tolist()[0] == [1.0, 2.0]


@pytest.mark.parametrize(
    ("time", "start", "row"),
    [
        ([0.0, 2.0, 1.0, 3.0], None, 2),
        ([0.0, 1.0, 2.0, 3.0], 0.5, 0),
        ([[0.0, 0.0], [1.0, 1.0], [2.0, 2.0], [3.0, 1.9]], None, 3),
    ],
)
def test_a_time_that_decreases_is_refused_by_row(
    time: list[float], start: float | None, row: int
) -> None:
    z = torch.zeros(4, 2, 1).double() if isinstance(time[0], list) else torch.zeros(4, 1).double()
    log = Log(("a",), tensor(time), z)
    with pytest.raises(InputError, match=f"decreases at row {row},"):
        log.intervals(start)


def test_select_takes_everything_of_a_trajectory() -> None:
    log = make(3, 4)
    start = Start(torch.arange(16.0).reshape(4, 4), torch.eye(4).expand(4, 4, 4) * 2, 0.5)
    names = ("p", "q", "r", "s")
    log = replace(log, start=start, names=names, time=torch.arange(12.0).reshape(3, 4))
    part = log.select([2, 0])
    assert torch.equal(part.z, log.z[:, [2, 0]])
    assert torch.equal(part.time, log.time[:, [2, 0]])
    assert log.truth is not None
    assert part.truth is not None
    assert torch.equal(part.truth, log.truth[:, [2, 0]])
    assert torch.equal(part.inputs["wind"], log.inputs["wind"][:, [2, 0]])
    assert part.names == ("r", "p")
    assert part.start is not None
    assert part.start.mean[:, 0].tolist() == [8.0, 0.0]
    assert part.start.time == 0.5
    assert part.start.covariance is not None
    assert part.start.covariance.shape == (2, 4, 4)


def test_rows_keep_the_start_only_from_the_first_row_on() -> None:
    log = replace(make(5, 2), start=Start(torch.zeros(2, 4)))
    assert log.rows(0, 2).start is log.start
    later = log.rows(2, 4)
    assert later.start is None
    assert torch.equal(later.z, log.z[2:4])
    assert later.time.tolist() == [2.0, 3.0]
    assert torch.equal(later.inputs["wind"], log.inputs["wind"][2:4])


def test_stacked_logs_are_padded_with_rows_that_hold_nothing() -> None:
    short, long = make(2), make(5, offset=100.0)
    both = stack_logs([replace(short, names=("s",)), replace(long, names=("l",))])
    assert both.names == ("s", "l")
    assert torch.equal(both.z[:2, 0], short.z)
    assert torch.equal(both.z[:, 1], long.z)
    assert both.z[2:, 0].isnan().all()
    assert both.truth is not None
    assert both.truth[2:, 0].isnan().all()
    assert both.truth[:2, 0].isfinite().all()
    assert both.time[:, 0].tolist() == [0.0, 1.0, 1.0, 1.0, 1.0]
    assert both.intervals()[2:, 0].tolist() == [0.0, 0.0, 0.0]
    assert torch.equal(both.inputs["wind"][4, 0], short.inputs["wind"][1])


def test_selecting_from_a_stack_gives_the_log_and_its_padding() -> None:
    logs = [make(2), make(3, offset=50.0)]
    back = stack_logs(logs).select([1])
    assert torch.equal(back.z[:, 0], logs[1].z)
    assert back.z.isfinite().all()


def test_truth_in_one_log_alone_is_refused() -> None:
    bare = replace(make(2), truth=None, truth_states=())
    with pytest.raises(InputError, match="different truth or input"):
        stack_logs([make(2), bare])
    assert stack_logs([bare, bare]).truth is None


def test_logs_that_differ_are_refused() -> None:
    with pytest.raises(InputError, match="found none, expected at least one"):
        stack_logs([])
    with pytest.raises(InputError, match="found channels c, d beside a, b"):
        stack_logs([make(2), replace(make(2), channels=("c", "d"))])
    with pytest.raises(InputError, match="different truth or input"):
        stack_logs([make(2), replace(make(2), inputs={})])


def test_another_precision_reaches_every_part() -> None:
    start = Start(torch.zeros(2, 4).double(), torch.eye(4).expand(2, 4, 4).double(), 0.0)
    log = replace(make(3, 2), start=start).to(torch.float32)
    assert log.start is not None
    assert log.truth is not None
    assert log.start.covariance is not None
    parts = [log.z, log.time, log.truth, log.inputs["wind"], log.start.mean, log.start.covariance]
    assert {part.dtype for part in parts} == {torch.float32}
