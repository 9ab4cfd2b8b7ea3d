"""Reverse-mode derivative of the measurement update, channel by channel.

Derived from the four equations of :func:`difffilter.core.conditioning.condition`; it spares
autograd's bookkeeping on tens of tiny operations per channel. The test
``test_condition_gradient.py`` holds it against autograd of the plain equations.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from difffilter.core.equations import ChannelUpdate, sweep

__all__ = ["ChannelSweep"]


class ChannelSweep(torch.autograd.Function):
    """:func:`difffilter.core.conditioning.sweep` with its own backward."""

    @staticmethod
    def forward(
        ctx: Any,
        deviations: Tensor,
        observed: Tensor,
        innovation: Tensor,
        weight: Tensor,
        noise: Tensor,
        floor: float | None = None,
    ) -> tuple[Tensor, ...]:
        """Run the sweep; keep the final table and what undoes each channel's update."""
        kept: list[ChannelUpdate] = []
        conditioned, table = sweep(
            deviations, observed, innovation, weight, noise, kept=kept, floor=floor
        )
        weight, noise = weight.movedim(-1, 0), noise.movedim(-1, 0)
        g, gain_rows, s, denominators = zip(*kept, strict=True)
        together = torch.stack(s), torch.stack(denominators)
        ctx.save_for_backward(weight, noise, table, *together, *g, *gain_rows)
        ctx.set_materialize_grads(False)
        return tuple(conditioned)

    @staticmethod
    @once_differentiable
    def backward(
        ctx: Any,
        shift_bar: Tensor | None,
        deviations_bar: Tensor | None,
        residual_bar: Tensor | None,
        observed_bar: Tensor | None,
    ) -> tuple[Tensor | None, ...]:
        """Gradients towards the five inputs (``x_bar`` = dLoss/dx)."""
        weight, noise, table, s, denominators, *updates = ctx.saved_tensors
        m, k = len(weight), table.shape[0] - 1
        n = table.shape[1] - m
        table = table.clone()
        table_bar = _final(table, n, (shift_bar, deviations_bar, residual_bar, observed_bar))

        # All channels at once, (m, k + 1, 1, ...)
        gains = weight[:, None, None] / denominators
        per_denominator = gains / denominators
        # denominator = s + root_r sqrt(s), so root_r / sqrt(s) = denominator / s - 1
        per_s = 0.5 * (per_denominator + gains / s[:, None, None])

        columns, columns_bar = table[:k], table_bar[:k]
        rows, rows_bar = (x[:, n:].chunk(m, dim=1) for x in (table, table_bar))
        back = []
        for i in reversed(range(m)):
            g, gain_row, row, row_bar = updates[i], updates[m + i], rows[i], rows_bar[i]
            # table' = table - g gain_row;  v = -dLoss/d(gain_row)
            table.addcmul_(g, gain_row)
            v = (table_bar * g).sum(1, keepdim=True)
            minus_g_bar = (table_bar * gain_row).sum(0)
            # gain_row = w / denominator row,  s = w g_i + r
            v_row = v * row
            s_bar = (v_row * per_s[i]).sum((0, 1))
            minus_g_bar[n + i].addcmul_(weight[i], s_bar, value=-1)
            # g = D f,  f = row i of D
            minus_f_bar = (columns * minus_g_bar).sum(1, keepdim=True)
            columns_bar.addcmul_(minus_g_bar, row[:k], value=-1)
            row_bar.addcmul_(v, gains[i], value=-1)
            row_bar[:k].sub_(minus_f_bar)
            back.append((v_row, s_bar, g[n + i]))

        v_rows, s_bar, g_own = (torch.stack(parts) for parts in zip(*reversed(back), strict=True))
        weight_bar = s_bar * g_own - (v_rows / denominators).sum((1, 2))
        # denominator = s + sqrt(r s), whose derivative towards r is taken as 0 at r = 0
        root_bar = 0.5 * (v_rows * per_denominator)[:, :k].sum((1, 2))
        noise_bar = s_bar + torch.where(noise > 0, root_bar * (s / noise).sqrt(), 0.0)
        return (
            columns_bar[:, :n].movedim((0, 1), (-1, -2)),
            columns_bar[:, n:].movedim((0, 1), (-1, -2)),
            table_bar[k, n:].movedim(0, -1),
            weight_bar.movedim(0, -1),
            noise_bar.movedim(0, -1),
            None,
        )


def _final(table: Tensor, n: int, bars: tuple[Tensor | None, ...]) -> Tensor:
    """The gradient towards the final table, from those towards what is read from it."""
    k, bar = len(table) - 1, torch.zeros_like(table)
    shift, deviations, residual, observed = bars
    if shift is not None:
        bar[k, :n] = -shift.movedim(-1, 0)
    if deviations is not None:
        bar[:k, :n] = deviations.movedim((-1, -2), (0, 1))
    if residual is not None:
        bar[k, n:] = residual.movedim(-1, 0)
    if observed is not None:
        bar[:k, n:] = observed.movedim((-1, -2), (0, 1))
    return bar
