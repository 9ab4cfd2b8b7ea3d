"""Estimates over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from difffilter.core.beliefs import Belief, Record
from difffilter.errors import InputError, shown

__all__ = ["Track"]


@dataclass(frozen=True)
class Track:
    """Estimates over time.

    Attributes:
        states, channels: names.
        time: (T,) or (T, ...).
        mean: (T, ..., n); deviations: (T, ..., n, k), P = X X^T.
        record: the steps' records stacked along time; None for estimators without one.
        modes: names of a mixture's modes, see ``record.modes``; none for all else.
        final: belief after the last row; None for estimators without one.
    """

    states: tuple[str, ...]
    channels: tuple[str, ...]
    time: Tensor
    mean: Tensor
    deviations: Tensor
    record: Record | None = None
    final: Belief | None = None
    modes: tuple[str, ...] = ()

    @property
    def covariance(self) -> Tensor:
        """(T, ..., n, n)."""
        return self.deviations @ self.deviations.mT

    @property
    def std(self) -> Tensor:
        """(T, ..., n), standard deviation of each state."""
        return self.deviations.square().sum(-1).sqrt()

    def named(self, names: Sequence[str]) -> list[int]:
        """Index of each named state."""
        missing = [name for name in names if name not in self.states]
        if missing:
            raise InputError(
                f"state: found {shown(missing[0])}, expected one of {', '.join(self.states)}"
            )
        return [self.states.index(name) for name in names]
