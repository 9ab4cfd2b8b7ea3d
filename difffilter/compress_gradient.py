"""Reverse-mode derivative of :func:`difffilter.linalg.compress`.

It spares autograd's bookkeeping on tens of tiny operations. The test ``test_linalg.py``
holds it against autograd of the plain equations and ``gradcheck``.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from difffilter.linalg import factor, gram, product

__all__ = ["Compress"]


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
        P' = P_below - c_below c_below^T. ``gram_bar`` is kept symmetric.
        """
        blocks = ctx.saved_tensors[: ctx.blocks]
        columns, *inverse_roots = ctx.saved_tensors[ctx.blocks :]
        n = columns.shape[0]
        columns_bar = lower_bar.movedim((-1, -2), (0, 1))
        gram_bar = torch.empty_like(columns)
        for j in reversed(range(n)):
            c, c_bar, half_root = columns[j, j:], columns_bar[j, j:], 0.5 * inverse_roots[j]
            if j + 1 < n:
                along = (gram_bar[j + 1 :, j + 1 :] * c[1:]).sum(1)
                c_bar = torch.cat([c_bar[:1], c_bar[1:].sub(along, alpha=2)])
            half = c_bar * half_root
            gram_bar[j, j:] = half
            gram_bar[j:, j] = half
            gram_bar[j, j] = torch.addcmul(
                2 * half[0], (half * c).sum(0), inverse_roots[j], value=-1
            )
        twice = 2 * gram_bar.movedim((0, 1), (-2, -1))
        lead = twice.shape[:-2]
        bars = [product(twice, x.expand(*lead, *x.shape[-2:])) for x in blocks]
        return tuple(bar.sum_to_size(x.shape) for bar, x in zip(bars, blocks, strict=True))
