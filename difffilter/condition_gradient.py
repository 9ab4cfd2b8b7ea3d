"""Reverse-mode derivative of the measurement update, channel by channel.

Derived from the four equations of :func:`difffilter.condition.condition`; it spares
autograd's bookkeeping on tens of tiny operations per channel. The test
``test_condition_gradient.py`` holds it against autograd of the plain equations.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from difffilter.condition import gain_root, sweep

__all__ = ["ChannelSweep"]


class ChannelSweep(torch.autograd.Function):
    """:func:`difffilter.condition.sweep` with its own backward."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Run the sweep; keep the final table and a row of it per channel, not every table."""
        conditioned, table, updates = sweep(*tensors)
        weight, noise = (x.movedim(-1, 0) for x in tensors[3:])
        rows, g, s = (torch.stack(parts) for parts in zip(*updates, strict=True))
        ctx.save_for_backward(weight, noise, table, rows, g, s)
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
    ) -> tuple[Tensor, ...]:
        """Gradients towards the five inputs (``x_bar`` = dLoss/dx)."""
        weight, noise, table, rows, g, s = ctx.saved_tensors
        m, k = rows.shape[0], rows.shape[1] - 1
        n = table.shape[1] - m
        table = table.clone()

        table_bar = torch.zeros_like(table)
        if shift_bar is not None:
            table_bar[k, :n] = -shift_bar.movedim(-1, 0)
        if deviations_bar is not None:
            table_bar[:k, :n] = deviations_bar.movedim((-1, -2), (0, 1))
        if residual_bar is not None:
            table_bar[k, n:] = residual_bar.movedim(-1, 0)
        if observed_bar is not None:
            table_bar[:k, n:] = observed_bar.movedim((-1, -2), (0, 1))

        # All channels at once, (m, k + 1, ...):  gain = w / (s + root_r sqrt(s))
        root_r, root_s = gain_root(noise, k), s.sqrt().unsqueeze(1)
        inverse = 1.0 / torch.addcmul(s.unsqueeze(1), root_r, root_s)
        gain = weight.unsqueeze(1) * inverse
        gain_rows = rows * gain
        per_denominator = gain_rows * inverse
        per_s = torch.addcmul(per_denominator, per_denominator, root_r / root_s, value=0.5)

        columns, columns_bar, rows_bar = table[:k], table_bar[:k], table_bar[:, n:].unbind(1)
        channels = zip(
            g,
            rows[:, :k].unsqueeze(2),
            gain,
            gain_rows.unsqueeze(2),
            per_s,
            weight,
            rows_bar,
            strict=True,
        )
        back: list[tuple[Tensor, Tensor]] = []
        for i, (g_i, f, gain_i, gain_row, per_s_i, w, row_bar) in reversed(
            list(enumerate(channels, start=n))
        ):
            # table' = table - g gain_row;  v = -dLoss/d(gain_row)
            table.addcmul_(g_i, gain_row)
            v = (table_bar * g_i).sum(1)
            minus_g_bar = (table_bar * gain_row).sum(0)
            # s = w g_i + r
            s_bar = (v * per_s_i).sum(0)
            minus_g_bar[i].addcmul_(w, s_bar, value=-1)
            # g = D f,  f = row i of D
            minus_f_bar = (columns * minus_g_bar).sum(1)
            columns_bar.addcmul_(minus_g_bar, f, value=-1)
            row_bar.addcmul_(v, gain_i, value=-1)
            row_bar[:k].sub_(minus_f_bar)
            back.append((v, s_bar))

        v, s_bar = (torch.stack(parts) for parts in zip(*reversed(back), strict=True))
        weight_bar = s_bar * g[:, n:].diagonal().movedim(-1, 0) - (v * rows * inverse).sum(1)
        root_bar = (v * per_denominator)[:, :k].sum(1) * s.sqrt()
        # sqrt(r) has derivative 0 at r = 0
        noise_bar = s_bar + torch.where(noise > 0, 0.5 * root_bar / noise.sqrt(), 0.0)
        return (
            columns_bar[:, :n].movedim((0, 1), (-1, -2)),
            columns_bar[:, n:].movedim((0, 1), (-1, -2)),
            table_bar[k, n:].movedim(0, -1),
            weight_bar.movedim(0, -1),
            noise_bar.movedim(0, -1),
        )
