"""Worlds of a family beside each other in one log, for the loss ``worlds``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.family import Family, Member
from difffilter.logs.log import Log, Start
from difffilter.running.batch import run, start_belief
from difffilter.scoring.losses import REFERENCE, WORLDS
from difffilter.scoring.metrics import Score, squared_error

__all__ = ["drawn_worlds", "marked"]

#: Trajectories of a member, at least: fewer say nothing of it.
LEAST = 8


def drawn_worlds(
    family: Family,
    filter: Recipe,
    count: int,
    seed: int,
    purpose: str,
    score: Score | str = "all",
) -> Log:
    """Trajectories of every member beside each other, started and marked.

    Args:
        count: in all; each member has as many as another, and at least ``LEAST``.
        score: of which states errors are.

    Raises:
        InputError: a recorded member, or one without truth.
    """
    each = max(count // len(family), LEAST)
    logs = [_one(member, filter, each, seed, purpose) for member in family]
    joined = _beside(logs)
    own = torch.eye(len(family), dtype=joined.z.dtype).repeat_interleave(each, 0)
    return marked(joined, filter, family, own, score)


def marked(
    log: Log, filter: Recipe, family: Family, members: Tensor, score: Score | str = "all"
) -> Log:
    """A started log with what the loss ``worlds`` reads beside its rows.

    Args:
        members: (B, k), 1 where a trajectory belongs to a member.
        score: of which states errors are.

    Returns:
        The log with inputs ``reference.squared`` (T, B), squared errors of the published filter,
        and ``worlds.members``, ``worlds.weight``, ``worlds.allow`` (T, B, k).
    """
    with torch.no_grad():
        squared = squared_error(log, run(filter, log, engine="torch"), score)
    weight = [m.weight * (m.role == "tune") for m in family]
    allow = [m.allow for m in family]
    rows = members.expand(log.steps, *members.shape)
    told = [rows, rows * rows.new_tensor(weight), rows * rows.new_tensor(allow)]
    inputs = dict(zip(WORLDS, told, strict=True))
    return replace(log, inputs={**log.inputs, REFERENCE: squared, **inputs})


def _one(member: Member, filter: Recipe, count: int, seed: int, purpose: str) -> Log:
    log = member.log(count, seed, purpose)
    if log.truth is None:
        raise InputError(f"world {member.name}: needs truth, found none")
    log = log.only(filter.channels)
    if log.start is None:
        if member.starter is None:
            raise InputError(f"world {member.name}: found no start, expected one, or a starter")
        log = member.starter(filter, log, None)
    assert log.start is not None
    # One time for all trajectories to one for each, so that worlds stand beside each other.
    time = log.time.reshape(log.steps, -1).expand(log.z.shape[:2])
    return replace(log, time=time, start=_whole(filter, log.start))


def _whole(filter: Recipe, start: Start) -> Start:
    """A start with a covariance, so that starts of either kind stand beside each other."""
    if start.covariance is not None or "start.sigma" in filter.declarations:
        return start
    begin = start_belief(filter, filter.prepare(), start)
    return replace(start, covariance=begin.deviations @ begin.deviations.mT)


def _beside(logs: Sequence[Log]) -> Log:
    """Trajectories of several logs, the shorter ones padded with rows without measurement."""
    steps = max(log.steps for log in logs)
    names = set.intersection(*(set(log.inputs) for log in logs))

    def padded(x: Tensor, empty: bool) -> Tensor:
        tail = x[-1:].expand(steps - len(x), *x.shape[1:])
        return torch.cat([x, torch.full_like(tail, torch.nan) if empty else tail])

    starts = [log.start for log in logs if log.start is not None]
    times = {start.time for start in starts}
    covariances = [start.covariance for start in starts if start.covariance is not None]
    if covariances and len(covariances) < len(starts):  # NaN: the filter's start.sigma
        covariances = [
            start.mean.new_full((*start.mean.shape, start.mean.shape[-1]), torch.nan)
            if start.covariance is None
            else start.covariance
            for start in starts
        ]
    if len(times) > 1:
        raise InputError("worlds: found starts of several kinds, expected the same in each")
    truths = [log.truth for log in logs if log.truth is not None]
    begin = Start(
        torch.cat([start.mean for start in starts]),
        torch.cat(covariances) if covariances else None,
        times.pop(),
    )
    return replace(
        logs[0],
        time=torch.cat([padded(log.time, False) for log in logs], 1),
        z=torch.cat([padded(log.z, True) for log in logs], 1),
        truth=torch.cat([padded(truth, True) for truth in truths], 1),
        inputs={
            name: torch.cat([padded(log.inputs[name], False) for log in logs], 1) for name in names
        },
        start=begin,
        names=tuple(name for log in logs for name in log.names),
    )
