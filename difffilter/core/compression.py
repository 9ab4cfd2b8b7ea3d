"""A square factor of stacked deviations, and its reverse-mode derivative.

It spares autograd's bookkeeping on tens of tiny operations. The test ``test_linalg.py``
holds it against autograd of the plain equations and ``gradcheck``.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from difffilter.core.linalg import factor, gram, needs_gradient, product, semidefinite_cholesky

__all__ = ["Compress", "compress"]


def compress(*blocks: Tensor) -> Tensor:
    """Square factor of the Gram matrix of [X_1, X_2, ...]: (..., n, k_i) -> (..., n, n)."""
    if needs_gradient(*blocks):
        lower: Tensor = Compress.apply(*blocks)  # type: ignore[no-untyped-call]
        return lower
    return semidefinite_cholesky(gram(blocks))


class Compress(torch.autograd.Function):
    """X_1, X_2, ... -> L with L L^T the sum of X_i X_i^T, with its own backward."""

    @staticmethod
    def forward(ctx: Any, *blocks: Tensor) -> Tensor:
        """Factor the Gram matrix; keep the X_i, the columns of L, the pivots' inverse roots."""
        columns, inverse_roots = factor(gram(blocks).movedim((-2, -1), (0, 1)))
        ctx.blocks = len(blocks)
        ctx.save_for_backward(*blocks, columns, *inverse_roots)
        return columns.movedim((0, 1), (-1, -2))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, lower_bar: Tensor) -> tuple[Tensor, ...]:
        """Undo the elimination column by column; ``x_bar`` = dLoss/dx.

        With P' = the remainder without its first row and column: c = p_1 / sqrt(p_11),
        P' = P_below - c_below c_below^T. ``twice`` is twice the gradient towards the Gram
        matrix, symmetric; only what is done so far is other than zero.
        """
        blocks = ctx.saved_tensors[: ctx.blocks]
        columns, *inverse_roots = ctx.saved_tensors[ctx.blocks :]
        n = columns.shape[0]
        below = columns.new_ones(n, n).triu().reshape(n, n, *(1,) * (columns.dim() - 2))
        columns_bar = lower_bar.movedim((-1, -2), (0, 1)) * below
        twice = torch.zeros_like(columns)
        each = zip(
            columns,
            columns_bar,
            inverse_roots,
            twice.unbind(0),
            twice.unbind(1),
            twice.diagonal().unbind(-1),
            strict=True,
        )
        for c, c_bar, inverse_root, along_row, along_column, pivot in reversed(list(each)):
            p_bar = (c_bar - (twice * c).sum(1)) * inverse_root
            along_row.add_(p_bar)
            along_column.add_(p_bar)
            pivot.addcmul_((p_bar * c).sum(0), inverse_root, value=-1)
        twice = twice.movedim((0, 1), (-2, -1))
        lead = twice.shape[:-2]
        bars = [product(twice, x.expand(*lead, *x.shape[-2:])) for x in blocks]
        return tuple(bar.sum_to_size(x.shape) for bar, x in zip(bars, blocks, strict=True))
