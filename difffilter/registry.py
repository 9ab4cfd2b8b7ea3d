"""Names for things: one table per kind, and a user's own entries work like built-in ones."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from typing import Generic, TypeVar

from difffilter.errors import InputError, shown

__all__ = ["NAME", "Registry"]

T = TypeVar("T")

#: What a name may look like: a letter, then letters (of any script), digits, ``_`` and ``-``.
NAME = re.compile(r"[^\W\d_][\w-]{0,63}")


class Registry(Mapping[str, T], Generic[T]):
    """Entries of one kind by name, in the order of their registration.

    Args:
        kind: what an entry is, for messages: ``weight``, ``sensor``.
        family: makes the entry of a name that nobody registered, or None if it is none either;
            such names are entries like the others, but are not listed.
        called: the family's names in words, for messages.

    Example:
        >>> colours: Registry[int] = Registry("colour")
        >>> colours.add("red", 0xFF0000)
        16711680
        >>> sorted(colours)
        ['red']
    """

    def __init__(
        self, kind: str, family: Callable[[str], T | None] | None = None, called: str = ""
    ) -> None:
        self.kind, self.family, self.called = kind, family, called
        self._entries: dict[str, T] = {}

    def add(self, name: str, entry: T) -> T:
        """Register an entry; InputError if the name is taken by another or is no name."""
        if not NAME.fullmatch(name):
            raise InputError(
                f"{self.kind}: found name {shown(name)}, expected a letter, then letters, digits, "
                "_ and -, at most 64"
            )
        if self._entries.setdefault(name, entry) is not entry:
            raise InputError(f"{self.kind} {name}: registered already, expected another name")
        return entry

    def register(self, name: str) -> Callable[[T], T]:
        """Decorator: ``@WEIGHTS.register("mine")``."""
        return lambda entry: self.add(name, entry)

    def remove(self, name: str) -> T:
        """Take an entry out again, and return it: to register a changed one in a notebook."""
        entry = self[name]
        del self._entries[name]
        return entry

    def __getitem__(self, name: str) -> T:
        found = self.get(name)
        if found is None:
            raise InputError(f"{self.kind}: found {shown(name)}, expected one of {self.names}")
        return found

    @property
    def names(self) -> str:
        """Every name in words, for messages."""
        return ", ".join([*self._entries, *([self.called] if self.called else [])])

    def __contains__(self, name: object) -> bool:
        return isinstance(name, str) and self.get(name) is not None

    def get(self, name: str, default: T | None = None) -> T | None:  # type: ignore[override]
        """The entry, or the default."""
        found = self._entries.get(name)
        if found is None and self.family is not None:
            found = self.family(name)
        return default if found is None else found

    def __iter__(self) -> Iterator[str]:
        return iter(self._entries)

    def __len__(self) -> int:
        return len(self._entries)
