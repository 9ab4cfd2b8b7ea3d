"""Entries by index, known before or computed, and writes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from difffilter.engine.rules.table import Array, Lower, array, rule
from difffilter.errors import EngineError

__all__: list[str] = []


@rule("index")
def _index(low: Lower, x: Array, indices: Sequence[Any]) -> Array:
    numbers: list[Any] = []
    for index in indices:
        if index is None:
            numbers.append(slice(None))
            continue
        values = low.known(index)
        if values is None:
            return _computed(low, x, indices)
        numbers.append(values.astype(int))
    return array(x[tuple(numbers)])


def _computed(low: Lower, x: Array, indices: Sequence[Any]) -> Array:
    """One index that is itself computed: a chain of choices."""
    given = [index for index in indices if index is not None]
    if len(given) != 1 or indices[0] is None:
        raise EngineError("engine: no rule for several computed indices")
    return _pick(low, x, given[0])


def _pick(low: Lower, x: Array, index: Array) -> Array:
    count = x.shape[0]
    shaped = index.reshape(*index.shape, *[1] * (x.ndim - 1))
    shaped = low.map("select", low.map("lt", shaped, 0.0), low.map("add", shaped, float(count)),
                     shaped)  # fmt: skip
    made = array(np.broadcast_to(array(x[0]), np.shape(index) + x.shape[1:]))
    for i in range(1, count):
        made = low.map("select", low.map("eq", shaped, float(i)), array(x[i]), made)
    return made


@rule("index_select")
def _index_select(low: Lower, x: Array, dim: int, index: Array) -> Array:
    values, moved = low.known(index), np.moveaxis(x, dim, 0)
    found = _pick(low, moved, index) if values is None else moved[np.atleast_1d(values).astype(int)]
    return np.moveaxis(array(found), 0, dim)


@rule("gather")
def _gather(low: Lower, x: Array, dim: int, index: Array, **_: Any) -> Array:
    moved, at = np.moveaxis(x, dim, 0), np.moveaxis(index, dim, 0)
    moved = moved[(slice(None), *(slice(n) for n in at.shape[1:]))]
    made = np.broadcast_to(array(moved[0]), at.shape)
    for i in range(1, moved.shape[0]):
        made = low.map("select", low.map("eq", at, float(i)), array(moved[i]), made)
    return np.moveaxis(made, 0, dim)


@rule("index_put")
def _index_put(
    low: Lower, x: Array, indices: Sequence[Any], value: Any, accumulate: bool = False, *_: Any
) -> Array:
    places: list[Any] = []
    for index in indices:
        known = None if index is None else low.known(index)
        if index is not None and known is None:
            raise EngineError("engine: no rule for a write at a computed index")
        places.append(slice(None) if known is None else known.astype(int))
    made, at = x.copy(), tuple(places)
    made[at] = low.map("add", made[at], value) if accumulate else value
    return made


@rule("copy")
def _copy(low: Lower, x: Array, value: Array, *_: Any) -> Array:
    return np.broadcast_to(value, x.shape)


@rule("fill")
def _fill(low: Lower, x: Array, value: Any) -> Array:
    return np.broadcast_to(low.of(value), x.shape)


@rule("zero")
def _zero(low: Lower, x: Array) -> Array:
    return low.constant(np.zeros(x.shape))


@rule("select_scatter")
def _select_scatter(low: Lower, x: Array, source: Array, dim: int, index: int) -> Array:
    made = x.copy()
    np.moveaxis(made, dim, 0)[index] = source
    return made


@rule("slice_scatter")
def _slice_scatter(
    low: Lower, x: Array, source: Array, dim: int = 0, start: Any = None, end: Any = None,
    step: int = 1,
) -> Array:  # fmt: skip
    made = x.copy()
    np.moveaxis(made, dim, 0)[start:end:step] = np.moveaxis(source, dim, 0)
    return made
