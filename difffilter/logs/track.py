"""Estimates over time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from difffilter.core.beliefs import Belief, Record
from difffilter.errors import InputError, shown
from difffilter.logs.states import kinds_by_name

__all__ = ["Track"]


@dataclass(frozen=True)
class Track:
    """Estimates over time.

    Attributes:
        states, channels: names.
        time: (T,) or (T, ...).
        mean: (T, ..., n); deviations: (T, ..., n, k), P = X X^T.
        record: the steps' records stacked along time; None for estimators without one.
        final: belief after the last row; None for estimators without one.
        modes: names of a mixture's modes, see ``record.modes``; none for all else.
        kinds: what each state is, one of :data:`difffilter.logs.states.KINDS`; by its name
            (x, vx) where it is not given.
        error_states: names of the rows of the deviations; none for the states themselves.
        local: (a, b) -> the shift (..., p) from a to b, where states are no plain numbers
            (quaternions), named by ``error_states``; None for the difference.
    """

    states: tuple[str, ...]
    channels: tuple[str, ...]
    time: Tensor
    mean: Tensor
    deviations: Tensor
    record: Record | None = None
    final: Belief | None = None
    modes: tuple[str, ...] = ()
    kinds: Mapping[str, str] = field(default_factory=dict)
    error_states: tuple[str, ...] = ()
    local: Callable[[Tensor, Tensor], Tensor] | None = None

    @property
    def errors(self) -> tuple[str, ...]:
        """Names of the rows of the deviations."""
        return self.error_states or self.states

    def kind(self, name: str) -> str:
        """What a state is: ``position``, ``velocity``, ``angle`` or ``other``."""
        return self.kinds.get(name) or kinds_by_name([name])[name]

    def rows(self, names: Sequence[str]) -> list[int]:
        """Index of each named state among the rows of the deviations."""
        return _places(names, self.errors)

    @property
    def covariance(self) -> Tensor:
        """(T, ..., p, p)."""
        return self.deviations @ self.deviations.mT

    @property
    def std(self) -> Tensor:
        """(T, ..., p), standard deviation of each row of ``errors``: of each state, as a rule."""
        return self.deviations.square().sum(-1).sqrt()

    def named(self, names: Sequence[str]) -> list[int]:
        """Index of each named state."""
        return _places(names, self.states)


def _places(names: Sequence[str], among: tuple[str, ...]) -> list[int]:
    missing = [name for name in names if name not in among]
    if missing:
        raise InputError(f"state: found {shown(missing[0])}, expected one of {', '.join(among)}")
    return [among.index(name) for name in names]
