"""Which parameters are tuned, by name or pattern."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase

from difffilter.errors import InputError
from difffilter.parameters.parameters import Parameter

__all__ = ["matching", "tuned_alone"]


def matching(declarations: Mapping[str, Parameter], patterns: Sequence[str]) -> list[str]:
    """Names of the parameters that a pattern names (``*`` and ``?`` as in file names).

    Raises:
        InputError: no pattern, or one that names nothing.
    """
    patterns = [patterns] if isinstance(patterns, str) else patterns
    if not patterns:
        raise InputError("tuned: found no name, expected one or more")
    found: list[str] = []
    for pattern in patterns:
        names = [name for name in declarations if fnmatchcase(name, pattern)]
        if not names:
            expected = ", ".join(declarations)
            raise InputError(f"tuned: found {pattern!r:.80}, expected names among {expected}")
        found += names
    return list(dict.fromkeys(found))


def tuned_alone(
    declarations: Mapping[str, Parameter], patterns: Sequence[str]
) -> dict[str, Parameter]:
    """The declarations with the parameters that the patterns name tuned, and no others.

    Raises:
        InputError: as :func:`matching`.
    """
    names = matching(declarations, patterns)
    return {name: replace(p, tuned=name in names) for name, p in declarations.items()}
