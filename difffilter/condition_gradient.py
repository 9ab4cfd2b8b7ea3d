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

from difffilter.condition import ChannelUpdate, gain_root, sweep

__all__ = ["ChannelSweep"]


class ChannelSweep(torch.autograd.Function):
    """:func:`difffilter.condition.sweep` with its own backward."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Run the sweep and keep each channel's intermediate values."""
        conditioned, updates = sweep(*tensors)
        weight, noise = (x.movedim(-1, 0) for x in tensors[3:])
        ctx.save_for_backward(weight, noise, *(tensor for update in updates for tensor in update))
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
        weight, noise, *saved = ctx.saved_tensors
        updates = [ChannelUpdate(*saved[i : i + 3]) for i in range(0, len(saved), 3)]
        table = updates[0].table
        k, n = table.shape[0] - 1, table.shape[1] - len(updates)

        table_bar = torch.zeros_like(table)
        if shift_bar is not None:
            table_bar[k, :n] = -shift_bar.movedim(-1, 0)
        if deviations_bar is not None:
            table_bar[:k, :n] = deviations_bar.movedim((-1, -2), (0, 1))
        if residual_bar is not None:
            table_bar[k, n:] = residual_bar.movedim(-1, 0)
        if observed_bar is not None:
            table_bar[:k, n:] = observed_bar.movedim((-1, -2), (0, 1))

        # All channels at once, (m, k + 1, 1, ...):  gain = w / (s + root_r sqrt(s))
        rows = torch.stack([u.table[:, i : i + 1] for i, u in enumerate(updates, start=n)])
        s = torch.stack([u.s for u in updates])
        root_r, root_s = gain_root(noise, k), s.sqrt()[:, None, None]
        inverse = 1.0 / torch.addcmul(s[:, None, None], root_r, root_s)
        gain = weight[:, None, None] * inverse
        direction = rows * gain
        per_denominator = direction * inverse
        per_s = torch.addcmul(per_denominator, per_denominator, root_r / root_s, value=0.5)

        back, s_bars = [], []
        for i in reversed(range(len(updates))):
            table, g, _ = updates[i]
            # table' = table - g (gain row);  v = -dLoss/d(gain row),  g_bar_minus = -dLoss/dg
            v = (table_bar * g).sum(1, keepdim=True)
            minus_g_bar = (table_bar * direction[i]).sum(0)
            # s = w g_i + r
            s_bar = (v * per_s[i]).sum((0, 1))
            minus_g_bar[n + i].addcmul_(weight[i], s_bar, value=-1)
            # g = D f,  f = row i of D
            minus_f_bar = (table[:k] * minus_g_bar).sum(1)
            table_bar[:k].addcmul_(minus_g_bar, rows[i, :k], value=-1)
            table_bar[:, n + i : n + i + 1].addcmul_(v, gain[i], value=-1)
            table_bar[:k, n + i].sub_(minus_f_bar)
            back.append(v)
            s_bars.append(s_bar)
        back.reverse()
        s_bars.reverse()

        v, s_bar = torch.stack(back), torch.stack(s_bars)
        g_own = torch.stack([u.g[i] for i, u in enumerate(updates, start=n)])
        weight_bar = s_bar * g_own - (v * rows * inverse).sum((1, 2))
        root_bar = (v * per_denominator)[:, :k].sum((1, 2)) * s.sqrt()
        # sqrt(r) has derivative 0 at r = 0
        noise_bar = s_bar + torch.where(noise > 0, 0.5 * root_bar / noise.sqrt(), 0.0)
        columns_bar = table_bar[:k].movedim((0, 1), (-1, -2))
        return (
            columns_bar[..., :n, :],
            columns_bar[..., n:, :],
            table_bar[k, n:].movedim(0, -1),
            weight_bar.movedim(0, -1),
            noise_bar.movedim(0, -1),
        )
