"""Fits of first rows that wait for more of them while they are ambiguous."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.logs.log import Log
from difffilter.parameters.values import Constants
from difffilter.start.fit import Frame
from difffilter.start.parts import Part, needed_channels
from difffilter.start.rows import Epochs, first_rows
from difffilter.start.search import Found, Problem, search

__all__ = ["Fitted", "Fitter"]

#: An ambiguous start waits: rows and span are doubled this often.
DOUBLINGS = 5
#: Trajectories fitted at once.
CHUNK = 128


class Fitted(NamedTuple):
    """Starts of some trajectories.

    Attributes:
        mean: (B, n); factor: (B, n, k), of what the fit says about the states.
        elapsed: (B,), s, by which the fit's time is later than the first row.
        moving: (B,), whether the velocity is fitted too.
    """

    mean: Tensor
    factor: Tensor
    elapsed: Tensor
    moving: Tensor


class Fitter(NamedTuple):
    """Fits with the same settings."""

    part: Part
    constants: Constants
    velocity: Tensor
    velocity_sigma: Tensor
    rows: int
    span: float
    scale: float
    iterations: int

    def all(self, log: Log) -> Fitted:
        """Every trajectory of a flat log, some at a time: memory does not grow with them."""
        fits = [
            self.fit(log.select(range(first, min(first + CHUNK, log.trajectories))), first)
            for first in range(0, log.trajectories, CHUNK)
        ]
        return Fitted(*(torch.cat(each) for each in zip(*fits, strict=True)))

    def fit(self, log: Log, first: int) -> Fitted:
        """Trajectories of a flat log; ``first``: the number of the first of them."""
        epochs = first_rows(log, self.rows, self.span, needed_channels(self.part))
        found = self._search(epochs, moving=False)
        done = self._fitted(epochs, found, moving=False)
        pending = found.ambiguous.nonzero().flatten()
        limit = len(pending)
        for i in range(DOUBLINGS):
            if not limit:
                break
            more = 2 ** (i + 1)
            part = log.select(pending)
            epochs = first_rows(
                part, more * self.rows, more * self.span, needed_channels(self.part)
            )
            found = self._search(epochs, moving=True)
            last = i == DOUBLINGS - 1
            over = epochs.complete | last
            self._refuse(part, pending + first, found, epochs, over)
            settled = ~found.ambiguous | over
            new = self._fitted(epochs, found, moving=True)
            at = pending[settled]
            done = Fitted(
                *(old.index_put((at,), x[settled]) for old, x in zip(done, new, strict=True))
            )
            pending = pending[~settled]
            limit = len(pending)
        return done

    def _frame(self, epochs: Epochs, moving: bool) -> Frame:
        """Position, or position and departure from the expected velocity, to the states."""
        part, since = self.part, epochs.since
        n, axes = len(part.states), part.axes
        unit = torch.eye(axes, dtype=since.dtype)
        if not moving and not bool(self.velocity.any()):  # the same state in all rows
            still = torch.nn.functional.pad(unit, (0, 0, 0, n - axes))
            return Frame(still, since.new_zeros(n), since.new_zeros(axes))
        offset = since.new_zeros(*since.shape, n)
        along = since.new_zeros(*since.shape, n, 2 * axes if moving else axes)
        along[..., :axes, :axes] = unit
        offset[..., :axes] = since.unsqueeze(-1) * self.velocity
        information = since.new_zeros(along.shape[-1])
        for i, v in enumerate(part.velocities):
            offset[..., v] = self.velocity[i]
        if moving:
            along[..., :axes, axes:] = since[..., None, None] * unit
            for i, v in enumerate(part.velocities):
                along[..., v, axes + i] = 1.0
            information[axes:] = self.velocity_sigma.square().reciprocal()
        return Frame(along.unsqueeze(1), offset.unsqueeze(1), information)

    def _moves(self, moving: bool) -> bool:
        return moving and bool(self.part.velocities)

    def _search(self, epochs: Epochs, moving: bool) -> Found:
        frame = self._frame(epochs, self._moves(moving))
        part = self.part
        problem = Problem(part.sensors, self.constants, epochs, frame, part.axes, self.scale)
        return search(problem, self.iterations)

    def _fitted(self, epochs: Epochs, found: Found, moving: bool) -> Fitted:
        """Mean and factor of the states at the first row's time."""
        part, moves = self.part, self._moves(moving)
        n, axes = len(part.states), part.axes
        size = len(found.unknown)
        mean = found.unknown.new_zeros(size, n)
        factor = found.unknown.new_zeros(size, n, 2 * axes)
        mean[:, :axes] = found.unknown[:, :axes]
        factor[:, :axes, : found.factor.shape[-1]] = found.factor[:, :axes]
        for i, v in enumerate(part.velocities):
            mean[:, v] = self.velocity[i]
            if moves:
                mean[:, v] = mean[:, v] + found.unknown[:, axes + i]
                factor[:, v] = found.factor[:, axes + i]
        moved = torch.full((size,), moves)
        elapsed = torch.zeros_like(epochs.elapsed) if moves else epochs.elapsed
        return Fitted(mean, factor, elapsed, moved)

    def _refuse(
        self, log: Log, numbers: Tensor, found: Found, epochs: Epochs, over: Tensor
    ) -> None:
        """InputError for the first trajectory whose rows are used up and that stays unclear."""
        rival = ~torch.isnan(found.rival).any(-1)
        unclear = over & (found.undetermined | found.contradicted | found.flat | rival)
        if not bool(unclear.any()):
            return
        at = int(unclear.nonzero()[0])
        name = log.names[at] if log.names and log.names[at] else int(numbers[at])
        where = f"start: trajectory {name}"
        if bool(found.undetermined[at]):
            raise InputError(f"{where}: its measurements never determine a position")
        read = f"its first {int(epochs.measured[at])} rows"
        needs = "expected other rows or sensors for the start, or the start itself"
        if bool(rival[at]):
            best, other = (_point(x[at, : self.part.axes]) for x in (found.unknown, found.rival))
            raise InputError(f"{where}: {read} fit {best} and {other} alike, {needs}")
        best = _point(found.unknown[at, : self.part.axes])
        if bool(found.flat[at]):
            raise InputError(f"{where}: {read} fit {best} and a valley beside it alike, {needs}")
        raise InputError(f"{where}: {read} contradict each other (best at {best}), {needs}")


def _point(position: Tensor) -> str:
    return "(" + ", ".join(f"{float(x):.6g}" for x in position) + ")"
