"""New tensors, and conversions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from difffilter.engine.rules.arithmetic import truncated
from difffilter.engine.rules.table import Array, Lower, rule
from difffilter.errors import EngineError

__all__: list[str] = []


@rule("zeros_like", "empty_like")
def _zeros_like(low: Lower, x: Array, **_: Any) -> Array:
    return low.constant(np.zeros(x.shape))


@rule("ones_like")
def _ones_like(low: Lower, x: Array, **_: Any) -> Array:
    return low.constant(np.ones(x.shape))


@rule("full_like")
def _full_like(low: Lower, x: Array, value: float, **_: Any) -> Array:
    return low.constant(np.full(x.shape, value))


@rule("zeros", "efficientzerotensor", "empty")
def _zeros(low: Lower, size: Sequence[int], **_: Any) -> Array:
    return low.constant(np.zeros(size))


@rule("empty_strided")
def _empty_strided(low: Lower, size: Sequence[int], *_: Any, **__: Any) -> Array:
    return low.constant(np.zeros(size))


@rule("new_zeros_with_same_feature_meta")
def _zeros_of_both(low: Lower, x: Array, other: Array, self_num_batch_dims: int = 0) -> Array:
    return low.constant(np.zeros((*x.shape[:self_num_batch_dims], *other.shape)))


@rule("ones")
def _ones(low: Lower, size: Sequence[int], **_: Any) -> Array:
    return low.constant(np.ones(size))


@rule("full")
def _full(low: Lower, size: Sequence[int], value: float, **_: Any) -> Array:
    return low.constant(np.full(size, value))


@rule("new_zeros", "new_empty")
def _new_zeros(low: Lower, x: Array, size: Sequence[int], **_: Any) -> Array:
    return low.constant(np.zeros(size))


@rule("new_ones")
def _new_ones(low: Lower, x: Array, size: Sequence[int], **_: Any) -> Array:
    return low.constant(np.ones(size))


@rule("new_full")
def _new_full(low: Lower, x: Array, size: Sequence[int], value: float, **_: Any) -> Array:
    return low.constant(np.full(size, value))


@rule("eye")
def _eye(low: Lower, n: int, m: int | None = None, **_: Any) -> Array:
    return low.constant(np.eye(n, n if not isinstance(m, int) else m))


@rule("scalar_tensor")
def _scalar(low: Lower, value: float, **_: Any) -> Array:
    return low.constant(value)


@rule("arange")
def _arange(low: Lower, *args: float, **_: Any) -> Array:
    return low.constant(np.arange(*args))


@rule("to_copy")
def _converted(low: Lower, x: Array, dtype: Any = None, **_: Any) -> Array:
    """Truth values by comparison, integers by what stands before the point."""
    x = low.of(x)  # torch hands over plain numbers too: 2 is no node
    if dtype in (None, torch.float64):
        return x
    if dtype == torch.bool:
        return low.map("ne", x, 0.0)
    if dtype in (torch.int32, torch.int64):
        return truncated(low, x)
    if low.known(x) is not None:
        return x
    raise EngineError(f"engine: no rule for a conversion to {dtype}, expected float64")
