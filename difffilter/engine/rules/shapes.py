"""Views, joins and rearrangements: the same entries elsewhere."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from difffilter.engine.rules.table import Array, Lower, array, rule

__all__: list[str] = []


@rule("slice")
def _slice(
    low: Lower, x: Array, dim: int = 0, start: Any = None, end: Any = None, step: int = 1
) -> Array:
    where: list[Any] = [slice(None)] * x.ndim
    where[dim] = slice(start, end, step)
    return array(x[tuple(where)])


@rule("narrow")
def _narrow(low: Lower, x: Array, dim: int, start: int, length: int) -> Array:
    start = start + x.shape[dim] if start < 0 else start
    return _slice(low, x, dim, start, start + length)


@rule("select")
def _select(low: Lower, x: Array, dim: int, index: int) -> Array:
    # A view, so that a later write through it is seen.
    where: list[Any] = [slice(None)] * (dim % x.ndim)
    return array(x[(*where, index, ...)])


@rule("unsqueeze")
def _unsqueeze(low: Lower, x: Array, dim: int) -> Array:
    return np.expand_dims(x, dim if dim >= 0 else dim + x.ndim + 1)


@rule("squeeze")
def _squeeze(low: Lower, x: Array, dim: Any = None) -> Array:
    axes = range(x.ndim) if dim is None else ([dim] if isinstance(dim, int) else dim)
    return np.squeeze(x, tuple(a for a in axes if x.ndim and x.shape[a] == 1))


@rule("expand")
def _expand(low: Lower, x: Array, size: Sequence[int], implicit: bool = False) -> Array:
    lead = len(size) - x.ndim
    full = [x.shape[i - lead] if s == -1 else s for i, s in enumerate(size)]
    return np.broadcast_to(x, full)


@rule("permute")
def _permute(low: Lower, x: Array, dims: Sequence[int]) -> Array:
    return np.transpose(x, [d % x.ndim for d in dims])


@rule("movedim")
def _movedim(low: Lower, x: Array, source: Any, destination: Any) -> Array:
    return np.moveaxis(x, source, destination)


@rule("transpose", "swapaxes")
def _transpose(low: Lower, x: Array, a: int, b: int) -> Array:
    return np.swapaxes(x, a, b) if x.ndim else x


@rule("t")
def _t(low: Lower, x: Array) -> Array:
    return x.T


@rule("view", "reshape", "unsafe_view", "reshape_alias")
def _view(low: Lower, x: Array, size: Any, *_: Any) -> Array:
    return x.reshape(size)


@rule("cat", "concat")
def _cat(low: Lower, parts: Sequence[Array], dim: int = 0) -> Array:
    return np.concatenate([p for p in parts if p.shape != (0,)] or parts, axis=dim)


@rule("stack")
def _stack(low: Lower, parts: Sequence[Array], dim: int = 0) -> Array:
    return np.stack(parts, axis=dim)


@rule("unbind")
def _unbind(low: Lower, x: Array, dim: int = 0) -> list[Array]:
    return [array(part) for part in np.moveaxis(x, dim, 0)]


@rule("split_with_sizes")
def _split_with_sizes(low: Lower, x: Array, sizes: Sequence[int], dim: int = 0) -> list[Array]:
    ends = np.cumsum(sizes)
    return [_slice(low, x, dim, int(e - s), int(e)) for s, e in zip(sizes, ends, strict=True)]


@rule("split")
def _split(low: Lower, x: Array, size: Any, dim: int = 0) -> list[Array]:
    if isinstance(size, (list, tuple)):
        return _split_with_sizes(low, x, size, dim)
    whole = x.shape[dim]
    return [_slice(low, x, dim, at, min(at + size, whole)) for at in range(0, max(whole, 1), size)]


@rule("roll")
def _roll(low: Lower, x: Array, shifts: Any, dims: Any = ()) -> Array:
    shifts = [shifts] if isinstance(shifts, int) else list(shifts)
    dims = [dims] if isinstance(dims, int) else list(dims)
    if not dims:
        return np.roll(x.reshape(-1), shifts[0]).reshape(x.shape)
    return np.roll(x, shifts, dims)


@rule("flip")
def _flip(low: Lower, x: Array, dims: Sequence[int]) -> Array:
    return np.flip(x, tuple(dims))


@rule("repeat")
def _repeat(low: Lower, x: Array, repeats: Sequence[int]) -> Array:
    return np.tile(x, tuple(repeats))


@rule("unfold")
def _unfold(low: Lower, x: Array, dim: int, size: int, step: int) -> Array:
    parts = [_slice(low, x, dim, at, at + size) for at in range(0, x.shape[dim] - size + 1, step)]
    return np.stack([np.moveaxis(p, dim, -1) for p in parts], axis=dim)


@rule("alias", "clone", "detach", "contiguous", "fw_primal")
@rule("lift_fresh", "lift_fresh_copy", "conj", "resolve_conj", "resolve_neg")
def _alias(low: Lower, x: Array, *_: Any, **__: Any) -> Array:
    return x


@rule("diagonal")
def _diagonal(low: Lower, x: Array, offset: int = 0, dim1: int = 0, dim2: int = 1) -> Array:
    found = np.diagonal(x, offset, dim1, dim2)
    found.setflags(write=x.flags.writeable)
    return found


@rule("diag_embed")
def _diag_embed(low: Lower, x: Array, offset: int = 0, dim1: int = -2, dim2: int = -1) -> Array:
    n = x.shape[-1] + abs(offset)
    made = low.constant(np.zeros((*x.shape[:-1], n, n)))
    for i in range(x.shape[-1]):
        made[..., i + max(-offset, 0), i + max(offset, 0)] = x[..., i]
    return np.moveaxis(made, (-2, -1), (dim1, dim2))


@rule("tril")
def _tril(low: Lower, x: Array, diagonal: int = 0) -> Array:
    kept = np.tri(x.shape[-2], x.shape[-1], diagonal, dtype=bool)
    return np.where(kept, x, low.constant(0.0))


@rule("triu")
def _triu(low: Lower, x: Array, diagonal: int = 0) -> Array:
    kept = ~np.tri(x.shape[-2], x.shape[-1], diagonal - 1, dtype=bool)
    return np.where(kept, x, low.constant(0.0))


@rule("trace")
def _trace(low: Lower, x: Array) -> Array:
    return low.fold("add", np.diagonal(x), None, False)


@rule("block_diag")
def _block_diag(low: Lower, blocks: Sequence[Array]) -> Array:
    blocks = [np.atleast_2d(block) for block in blocks]
    made = low.constant(np.zeros(np.sum([b.shape for b in blocks], axis=0)))
    row = column = 0
    for block in blocks:
        rows, columns = block.shape
        made[row : row + rows, column : column + columns] = block
        row, column = row + rows, column + columns
    return made


@rule("constant_pad_nd")
def _pad(low: Lower, x: Array, pad: Sequence[int], value: float = 0) -> Array:
    widths = [(0, 0)] * x.ndim
    for i in range(len(pad) // 2):
        widths[x.ndim - 1 - i] = (pad[2 * i], pad[2 * i + 1])
    shape = [n + max(a, 0) + max(b, 0) for n, (a, b) in zip(x.shape, widths, strict=True)]
    made = low.constant(np.full(shape, float(value)))
    made[tuple(slice(max(a, 0), max(a, 0) + n) for n, (a, _) in zip(x.shape, widths, strict=True))
         ] = x  # fmt: skip
    return made[tuple(slice(max(-a, 0), n - max(-b, 0)) for n, (a, b) in
                      zip(shape, widths, strict=True))]  # fmt: skip
