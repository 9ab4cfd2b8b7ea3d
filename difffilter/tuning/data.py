"""Training, validation and test data: simulated trajectories, or windows of recorded logs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief
from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run, start_belief
from difffilter.seeds import stream

__all__ = ["Batch", "Trajectories", "Windows", "blank", "concatenate", "shuffled"]


@dataclass(frozen=True)
class Batch:
    """Logs for one gradient, with their starts."""

    log: Log
    start: Start | Belief


@dataclass
class Trajectories:
    """Simulated trajectories (or short logs): a batch is a random choice of whole ones."""

    log: Log
    start: Start

    @property
    def count(self) -> int:
        """Number of trajectories to shuffle."""
        return self.log.trajectories

    def batch(self, index: Tensor) -> Batch:
        """The trajectories at ``index``."""
        chosen = replace(self.log, start=self.start).select(index)
        assert chosen.start is not None
        return Batch(replace(chosen, start=None), chosen.start)

    def refresh(self, filter: Recipe, values: Values, step: int) -> bool:
        """Nothing to do: trajectories start where they start."""
        return False

    def keep(self) -> dict[str, Tensor]:
        """Nothing to keep."""
        return {}

    def restore(self, kept: dict[str, Tensor]) -> None:
        """Nothing to restore."""


@dataclass
class Windows:
    """Windows of long recorded logs, each started from the belief that the filter had there.

    The beliefs come from a run of the current values over the whole logs, without gradient,
    made anew every ``every`` gradient steps. A window's row 0 is the last row of the one
    before, without measurement and truth: it only carries the belief's time.
    """

    log: Log
    start: Start
    rows: int
    every: int
    engine: str = "torch"
    cut: Log | None = None
    beliefs: Belief | None = None

    def __post_init__(self) -> None:
        if self.log.z.dim() != 3:
            shape = list(self.log.z.shape)
            raise InputError(f"logs: found shape {shape}, expected (T, B, m), see stack_logs")
        # One time for all trajectories to one for each: windows stand beside each other.
        time = self.log.time.reshape(self.log.steps, -1).expand(self.log.z.shape[:2])
        log = replace(self.log, time=time)
        before = blank(log.rows(0, 1))
        if self.start.time is not None:
            before = replace(before, time=torch.full_like(before.time, self.start.time))
        log = concatenate([before, log])
        missing = -(log.steps - 1) % self.rows
        tail = blank(log.rows(log.steps - 1, log.steps))
        self.padded = concatenate([log, *[tail] * missing])
        self.edges = range(0, self.padded.steps - 1, self.rows)
        parts = [self.padded.rows(at, at + self.rows + 1) for at in self.edges]
        cut = concatenate(
            [
                _beside([blank(p.rows(0, 1)) for p in parts]),
                _beside([p.rows(1, p.steps) for p in parts]),
            ]
        )
        useful = cut.measured
        if cut.truth is not None:
            useful = useful & torch.isfinite(cut.truth).all(-1)
        self.useful = useful.any(0).nonzero().flatten()
        if not len(self.useful):
            raise InputError("logs: found no row with a measurement, expected some")
        self.cut = cut

    @property
    def count(self) -> int:
        """Number of windows that hold something to learn from."""
        return len(self.useful)

    def refresh(self, filter: Recipe, values: Values, step: int) -> bool:
        """Renew the windows' warm starts with the current values, if it is time to."""
        if self.beliefs is not None and step % self.every:
            return False
        beliefs: list[Belief] = []
        with torch.no_grad():
            frozen = {name: value.detach() for name, value in values.items()}
            current = start_belief(filter, filter.prepare(frozen), self.start)
            for at in self.edges:
                beliefs.append(current)
                part = self.padded.rows(at, at + self.rows + 1)
                part = concatenate([blank(part.rows(0, 1)), part.rows(1, part.steps)])
                final = run(filter, part, frozen, current, engine=self.engine).final
                assert final is not None
                current = final
        self.beliefs = Belief(
            torch.cat([b.mean for b in beliefs]),
            torch.cat([b.deviations for b in beliefs]),
            {k: torch.cat([b.memory[k] for b in beliefs]) for k in beliefs[0].memory},
        )
        return True

    def keep(self) -> dict[str, Tensor]:
        """The warm starts, for a resumable state: resuming must not renew them early."""
        if self.beliefs is None:
            return {}
        kept = {"mean": self.beliefs.mean, "deviations": self.beliefs.deviations}
        return kept | {f"memory.{name}": value for name, value in self.beliefs.memory.items()}

    def restore(self, kept: dict[str, Tensor]) -> None:
        """Inverse of :meth:`keep`."""
        if kept:
            memory = {
                name.removeprefix("memory."): value
                for name, value in kept.items()
                if name.startswith("memory.")
            }
            self.beliefs = Belief(kept["mean"], kept["deviations"], memory)

    def batch(self, index: Tensor) -> Batch:
        """The useful windows at ``index``."""
        assert self.cut is not None
        assert self.beliefs is not None
        at = self.useful[index]
        memory = {name: value[at] for name, value in self.beliefs.memory.items()}
        belief = Belief(self.beliefs.mean[at], self.beliefs.deviations[at], memory)
        return Batch(self.cut.select(at), belief)


def blank(log: Log) -> Log:
    """The same rows without measurement and truth."""
    truth = None if log.truth is None else torch.full_like(log.truth, torch.nan)
    return replace(log, z=torch.full_like(log.z, torch.nan), truth=truth, start=None)


def concatenate(parts: list[Log]) -> Log:
    """Rows after rows."""
    return _combine(parts, 0)


def _beside(parts: list[Log]) -> Log:
    """Trajectories beside trajectories."""
    return _combine(parts, 1)


def _combine(parts: list[Log], dim: int) -> Log:
    truth = [part.truth for part in parts if part.truth is not None]
    return replace(
        parts[0],
        time=torch.cat([part.time for part in parts], dim),
        z=torch.cat([part.z for part in parts], dim),
        truth=torch.cat(truth, dim) if truth else None,
        inputs={n: torch.cat([p.inputs[n] for p in parts], dim) for n in parts[0].inputs},
        start=None,
        names=(),
    )


def shuffled(count: int, size: int, seed: int, step: int) -> Tensor:
    """Indices of the mini-batch of a gradient step: epochs without replacement.

    A function of (seed, step) alone, so that a resumed run sees the same batches.
    """
    size = min(size, count)
    per_epoch = count // size
    epoch, place = divmod(step, per_epoch)
    order = torch.randperm(count, generator=stream(seed, "batches", epoch))
    return order[place * size : (place + 1) * size]
