"""Rows as a stream gives them: numbers in order or by channel, and known inputs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from torch import Tensor

from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe

__all__ = ["Given", "Known", "needs_inputs", "numbers"]

#: A row: numbers in the filter's order, or by channel.
Given = Tensor | Sequence[float | None] | Mapping[str, float | None]
#: Known inputs by name.
Known = Mapping[str, Tensor | Sequence[float] | float]


def numbers(z: Given, channels: Sequence[str]) -> Tensor | list[float]:
    """z in the order of the channels, NaN where missing."""
    if isinstance(z, Tensor):
        return z
    if isinstance(z, Mapping):
        unknown = set(z) - set(channels)
        if unknown:
            raise InputError(f"z: found channel {min(unknown)!r}, expected {', '.join(channels)}")
        z = [z.get(name) for name in channels]
    try:
        return [math.nan if v is None else float(v) for v in z]
    except (TypeError, ValueError):
        raise InputError(f"z: found {z!r}, expected numbers or None") from None


def needs_inputs(filter: Recipe) -> bool:
    """Whether a step of the filter reads known inputs."""
    try:
        filter.check_inputs({})
    except InputError:
        return True
    return False
