"""Faults: what is done to measurements beyond their nominal noise."""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from difffilter.scenario.distribution import Distribution, read_distribution
from difffilter.scenario.sensing import SensorSpec
from difffilter.scenario.table import Table

__all__ = ["Fault", "read_fault"]

KINDS = ("offset", "zero", "dropout")


@dataclass(frozen=True)
class Fault:
    """One kind of fault on some channels.

    Attributes:
        kind: ``offset`` (``size`` is added: a bias, an NLOS delay, an outlier, a burst),
            ``zero`` (the measurement reads 0), ``dropout`` (it is missing).
        channels: glob patterns of channel names.
        probability: that a fault begins, per step (and per channel unless ``joint``).
        duration: steps that a fault lasts (over 1: a burst).
        windows: steps (first, last), inclusive, in which faults begin; all if empty.
        joint: whether all its channels are struck together, by the same offset.
        size: distribution of the offset, times ``scale`` to SI units.
    """

    name: str
    kind: str
    channels: tuple[str, ...]
    probability: float
    duration: int
    windows: tuple[tuple[int, int], ...]
    joint: bool
    size: Distribution
    scale: float

    def strike(
        self, z: Tensor, channels: Sequence[str], generator: Generator
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Apply to z (T, B, m), whose row 0 is step 1.

        Returns:
            The new z, and what a clairvoyant is told, each (T, B, m): mean and variance of
            the error that the fault added, given where it struck (infinite variance for a
            zeroed channel).
        """
        steps, trajectories, m = z.shape
        concerned = torch.tensor([self.concerns(name) for name in channels])
        width = 1 if self.joint else m
        shape = (steps, trajectories, width)
        begins = torch.rand(shape, generator=generator, dtype=torch.float64) < self.probability
        begins = begins & self._open(steps)[:, None, None]
        struck = begins
        for late in range(1, min(self.duration, steps)):
            struck = struck | torch.nn.functional.pad(begins, (0, 0, 0, 0, late, 0))[:steps]
        struck = struck.expand(steps, trajectories, m) & concerned
        zero = torch.zeros_like(z)
        if self.kind == "dropout":
            return torch.where(struck, torch.nan, z), zero, zero
        if self.kind == "zero":
            return torch.where(struck, 0.0, z), zero, torch.where(struck, math.inf, zero)
        offset = self.scale * self.size.sample(shape, generator)
        return (
            torch.where(struck, z + offset, z),
            torch.where(struck, self.scale * self.size.mean, zero),
            torch.where(struck, self.scale**2 * self.size.variance, zero),
        )

    def concerns(self, channel: str) -> bool:
        """Whether the fault can strike a channel."""
        return any(fnmatch.fnmatchcase(channel, pattern) for pattern in self.channels)

    def _open(self, steps: int) -> Tensor:
        if not self.windows:
            return torch.ones(steps, dtype=torch.bool)
        k = torch.arange(1, steps + 1)
        inside = [(k >= first) & (k <= last) for first, last in self.windows]
        return torch.stack(inside).any(0)


def read_fault(name: str, table: Table, sensors: Iterable[SensorSpec]) -> Fault:
    """Read ``[faults.NAME]``."""
    owners = {channel: sensor for sensor in sensors for channel in sensor.model.channels}
    channels = tuple(owners)
    kind = table.text("kind", choices=KINDS)
    patterns = table.names("channels", ("*",))
    for pattern in patterns:
        if not fnmatch.filter(channels, pattern):
            table.fail("channels", f"patterns that match some of {', '.join(channels)}")
    if not patterns:
        table.fail("channels", "one pattern or more")
    windows = table.points("windows") if "windows" in table else ()
    for window in windows:
        whole = len(window) == 2 and all(step.is_integer() for step in window)
        if not whole or not 1 <= window[0] <= window[1]:
            table.fail("windows", "a list of [first, last] steps, from 1, first <= last")
    if kind == "offset":
        struck = [owners[c] for c in channels if any(fnmatch.fnmatchcase(c, p) for p in patterns)]
        bases, levels = ({s.model.unit for s in struck}, {s.sigma for s in struck})
        if len(bases) > 1:
            table.fail("channels", "channels of lengths or of angles, not of both")
        level = levels.pop() if len(levels) == 1 else None
        size, scale = read_distribution(table, None), table.unit(bases.pop(), level)
        scale *= table.number("scale", 1.0)
    else:
        size, scale = Distribution("constant", (0.0,), (0.0,)), 1.0
    fault = Fault(
        name=name,
        kind=kind,
        channels=patterns,
        probability=table.number("probability", 1.0, low=0.0, high=1.0),
        duration=table.integer("duration", 1, low=1),
        windows=tuple((int(first), int(last)) for first, last in windows),
        joint=table.flag("joint"),
        size=size,
        scale=scale,
    )
    table.finish()
    return fault
