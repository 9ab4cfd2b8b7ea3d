"""What a run refuses, and what it names when numbers turn non-finite."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from helpers import tensor
from run_cases import airport_log, make, tdoa
from torch import Tensor

from difffilter.core.beliefs import belief
from difffilter.errors import InputError, NonFiniteError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.motions.blocks import ConstantVelocity
from difffilter.running.batch import check_finite, run
from difffilter.sensors.sensor import FunctionSensor

LOG = airport_log()


WRONG: dict[str, tuple[Callable[[], object], str]] = {
    "channels": (
        lambda: run(make(), replace(LOG, channels=tuple("abcdefg"))),
        "found channels a, b, c, d, e, f, g, expected tdoa_2, tdoa_3",
    ),
    "order of channels": (
        lambda: run(make(), replace(LOG, channels=LOG.channels[::-1])), "expected tdoa_2",
    ),
    "no start": (lambda: run(make(), replace(LOG, start=None)), "start: found none"),
    "states": (
        lambda: run(make(), LOG, start=Start(torch.zeros(3).double())),
        r"start: found mean of shape \[3\], expected 4 numbers \(x, y, vx, vy\)",
    ),
    "states of a belief": (
        lambda: run(make(), LOG, start=belief(torch.zeros(3), torch.eye(3))), r"shape \[3\]",
    ),
    "trajectories": (
        lambda: run(make(), LOG, start=Start(torch.zeros(5, 4).double())),
        r"found mean of shape \[5, 4\], expected \[3, 4\]",
    ),
    "covariance": (
        lambda: run(make(), LOG, start=Start(torch.zeros(4), torch.eye(3))), "covariance: found",
    ),
    "covariance not positive": (
        lambda: run(make(), LOG, start=Start(torch.zeros(4), -torch.eye(4))), "negative eigenv",
    ),
    "no covariance": (
        lambda: run(Filter(ConstantVelocity(2), (tdoa(),)), LOG),
        "found no covariance, expected one, or a filter with start.sigma",
    ),
    "late start": (
        lambda: run(make(), LOG, start=replace(LOG.start, time=1.0)), "decreases at row 0",
    ),
    "unknown value": (lambda: run(make(), LOG, {"imq.k": tensor(1.0)}), "imq.k: no such param"),
    "bad value": (lambda: run(make(), LOG, {"tdoa.sigma": tensor(-1.0)}), "tdoa.sigma: found"),
    "no row": (lambda: run(make(), LOG.rows(0, 0)), "found no row"),
    "faults not told": (
        lambda: run(make(clairvoyant=True), LOG), "found no input fault.mean",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", WRONG)
def test_what_does_not_fit_is_an_input_error(name: str) -> None:
    attempt, message = WRONG[name]
    with pytest.raises(InputError, match=message):
        attempt()


def _nan_at(row: int, trajectory: int, channel: str) -> tuple[Filter, Log]:
    """A sensor whose prediction is NaN at one row of one trajectory, in one channel."""
    names = ("east", "north")

    def h(x: Tensor, inputs: object, values: object) -> Tensor:
        return x[..., :2] + inputs["poison"]  # type: ignore[index]

    poison = torch.zeros(6, 3, 2).double()
    poison[row, trajectory, names.index(channel)] = torch.nan
    filter = Filter(ConstantVelocity(2), (FunctionSensor(names, h, 1.0),), start_sigma=1.0)
    log = Log(names, torch.arange(6).double(), torch.zeros(6, 3, 2).double())
    return filter, replace(log, inputs={"poison": poison}, start=Start(torch.zeros(3, 4).double()))


@pytest.mark.parametrize(("row", "trajectory", "channel"), [(0, 0, "north"), (4, 2, "east")])
def test_a_non_finite_step_names_trajectory_step_and_channel(
    row: int, trajectory: int, channel: str
) -> None:
    filter, log = _nan_at(row, trajectory, channel)
    with pytest.raises(NonFiniteError, match=r"^innovation is not finite") as caught:
        run(filter, log)
    error = caught.value
    assert (error.trajectory, error.step, error.channel) == (trajectory, row, channel)


@pytest.mark.parametrize("what", ["mean", "covariance"])
def test_the_first_belief_that_is_not_finite_is_named(what: str) -> None:
    track = run(make(), LOG)
    part = {"mean": track.mean, "covariance": track.deviations}[what]
    part[9, 0] = torch.nan
    part[7, 2, 3] = torch.inf
    with pytest.raises(NonFiniteError, match=f"{what} is not finite") as caught:
        check_finite(track)
    error = caught.value
    assert (error.trajectory, error.step, error.channel) == (2, 7, "vy")
