"""The first measured rows of each trajectory of a log."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.logs.log import Log

__all__ = ["Epochs", "first_rows", "flatten"]


class Epochs(NamedTuple):
    """Rows gathered to a common length E, for B trajectories.

    Attributes:
        z: (E, B, m), NaN where missing or where a trajectory has fewer rows.
        inputs: known inputs (E, B, ...).
        since: (E, B), s, from the log's first row; 0 where there is no row.
        measured: (B,), how many rows.
        complete: (B,), whether no measured row is left.
    """

    z: Tensor
    inputs: Mapping[str, Tensor]
    since: Tensor
    measured: Tensor
    complete: Tensor

    @property
    def elapsed(self) -> Tensor:
        """(B,), s, from the log's first row to the mean time of the rows."""
        return self.since.sum(0) / self.measured.clamp_min(1)

    def select(self, at: Tensor) -> Epochs:
        """Some of the trajectories."""
        inputs = {name: value[:, at] for name, value in self.inputs.items()}
        rest = (self.since[:, at], self.measured[at], self.complete[at])
        return Epochs(self.z[:, at], inputs, *rest)


def flatten(log: Log) -> Log:
    """The measurements with one dimension of trajectories: z (T, B, m), time (T, B)."""
    lead = log.z.shape[1:-1]
    size = lead.numel()

    def each(value: Tensor) -> Tensor:
        if value.dim() == 1:  # shared by all trajectories
            value = value[(..., *[None] * len(lead))].expand(log.steps, *lead)
        return value.reshape(log.steps, size, *value.shape[1 + len(lead) :])

    inputs = {name: each(value) for name, value in log.inputs.items()}
    time = log.time.reshape(log.steps, -1).expand(-1, size)
    z = log.z.reshape(log.steps, size, -1)
    return Log(log.channels, time, z, inputs=inputs, names=log.names)


def first_rows(log: Log, rows: int, span: float, needed: int) -> Epochs:
    """The first ``rows`` measured rows of each trajectory, within ``span`` seconds.

    Further rows follow until ``needed`` different channels were seen (or as many as the
    whole trajectory has).

    Args:
        log: from :func:`flatten`.
    """
    measured = log.measured
    rank = measured.cumsum(0)
    begin = measured.to(torch.int8).argmax(0, keepdim=True)
    since = log.time - log.time.gather(0, begin)
    seen = (log.present.cumsum(0) > 0).sum(-1)
    before = torch.cat([torch.zeros_like(seen[:1]), seen[:-1]])
    short = before < seen[-1:].clamp_max(needed)
    wanted = measured & (((rank <= rows) & (since <= span)) | short)
    length = max(int(wanted.sum(0).max()), 1)
    index = torch.argsort(wanted.to(torch.int8), dim=0, descending=True, stable=True)[:length]
    valid = wanted.gather(0, index)

    def gather(x: Tensor) -> Tensor:
        at = index.reshape(*index.shape, *[1] * (x.dim() - 2))
        return x.gather(0, at.expand(-1, -1, *x.shape[2:]))

    z = torch.where(valid.unsqueeze(-1), gather(log.z), torch.nan)
    time = torch.where(valid, gather(log.time) - log.time[0], 0.0)
    inputs = {name: gather(value) for name, value in log.inputs.items()}
    taken = wanted.sum(0)
    return Epochs(z, inputs, time, taken, taken >= measured.sum(0))
