"""Families of worlds: named sources of logs that one set of values must serve."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from difffilter.errors import InputError, shown
from difffilter.logs.log import Log
from difffilter.registry import NAME

__all__ = ["ROLES", "Family", "Member"]

#: ``tune``: its gain counts, and it must not get worse; ``guard``: the latter alone.
ROLES = ("tune", "guard")

#: Draws so many trajectories: (trajectories, seed, purpose) to a log.
Source = Callable[[int, int, str], Log]
#: Gives a log its start: (recipe, log, values or None) to the log with a start.
Starter = Callable[[Any, Log, Mapping[str, Tensor] | None], Log]


@dataclass(frozen=True)
class Member:
    """One world of a family.

    Attributes:
        name: a name (see :data:`difffilter.registry.NAME`).
        source: a recorded log, or a function (trajectories, seed, purpose) that draws one:
            the same three give the same log, other seeds and purposes disjoint ones.
        weight: of its gain among the members that are tuned.
        role: ``tune``: its gain counts; ``guard``: it only must not get worse.
        allow: largest RMSE relative to the published values'.
        plausible: why this may happen, for the reader; "" where nobody says.
        starter: gives a log that has no start one: (recipe, log, values) to a log; None for
            that of whoever works on the family.

    Raises:
        InputError: a name that is none, a weight that is not finite and above 0, an unknown
            role, or ``allow`` below 1.
    """

    name: str
    source: Log | Source
    weight: float = 1.0
    role: str = "tune"
    allow: float = 1.02
    plausible: str = ""
    starter: Starter | None = None

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise InputError(f"world: found name {self.name[:80]!r}, expected a name")
        if not 0.0 < self.weight < float("inf"):
            raise InputError(
                f"world {self.name}: weight: found {self.weight}, expected a number above 0"
            )
        if self.role not in ROLES:
            raise InputError(
                f"world {self.name}: role: found {shown(self.role)}, "
                f"expected one of {', '.join(ROLES)}"
            )
        if not 1.0 <= self.allow < float("inf"):
            raise InputError(
                f"world {self.name}: allow: found {self.allow}, expected a number of 1 or more"
            )

    @property
    def recorded(self) -> bool:
        """Whether its log is recorded: there is only that one."""
        return isinstance(self.source, Log)

    def log(self, trajectories: int, seed: int = 0, purpose: str = "log") -> Log:
        """So many trajectories; a recorded log is what it is."""
        if isinstance(self.source, Log):
            return self.source
        return self.source(trajectories, seed, purpose)


@dataclass(frozen=True)
class Family:
    """Worlds that one set of values must serve; the first is the one that was published.

    Example:
        >>> import torch
        >>> from difffilter import Family, Log, Member
        >>> log = Log(("x",), torch.arange(2.0), torch.zeros(2, 1))
        >>> family = Family((Member("calm", log), Member("storm", log, role="guard")))
        >>> family["storm"].allow, [member.name for member in family.tuned]
        (1.02, ['calm'])

    Raises:
        InputError: no member, a name twice, none whose role is ``tune``.
    """

    members: tuple[Member, ...]

    def __post_init__(self) -> None:
        names = [member.name for member in self.members]
        if not names:
            raise InputError("worlds: found none, expected one or more")
        for name in names:
            if names.count(name) > 1:
                raise InputError(f"worlds: found {name} twice, expected a name once")
        if not self.tuned:
            raise InputError("worlds: found guards alone, expected one or more with role tune")

    def __iter__(self) -> Iterator[Member]:
        return iter(self.members)

    def __len__(self) -> int:
        return len(self.members)

    def __getitem__(self, name: str) -> Member:
        for member in self.members:
            if member.name == name:
                return member
        expected = ", ".join(member.name for member in self.members)
        raise InputError(f"world: found {shown(name)}, expected one of {expected}")

    @property
    def tuned(self) -> tuple[Member, ...]:
        """Members whose gain counts."""
        return tuple(member for member in self.members if member.role == "tune")
