"""Reverse-mode derivative of the measurement update, channel by channel.

Derived from the four equations of :func:`difffilter.condition.condition`; it spares
autograd's bookkeeping on tens of tiny operations per channel. The test
``test_condition.py`` holds it against autograd of the plain equations and ``gradcheck``.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from difffilter.condition import ChannelUpdate, sweep

__all__ = ["ChannelSweep"]


class ChannelSweep(torch.autograd.Function):
    """:func:`difffilter.condition.sweep` with its own backward."""

    @staticmethod
    def forward(
        ctx: Any, joint: Tensor, mean: Tensor, weight: Tensor, noise: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Run the sweep and keep each channel's intermediate values."""
        joint, mean, updates = sweep(joint, mean, weight, noise)
        ctx.save_for_backward(weight, noise, *(tensor for update in updates for tensor in update))
        return joint, mean

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, joint_bar: Tensor, mean_bar: Tensor) -> tuple[Tensor, ...]:
        """Gradients towards joint, mean, weight and noise (``x_bar`` = dLoss/dx)."""
        weight, noise, *saved = ctx.saved_tensors
        m, size = weight.shape[0], len(ChannelUpdate._fields)
        joint_bar, mean_bar = joint_bar.clone(), mean_bar.clone()
        weight_bar, noise_bar = torch.empty_like(weight), torch.empty_like(noise)
        for i in reversed(range(m)):
            joint, mean, f, g, s, root = saved[i * size : (i + 1) * size]
            w, r, row = weight[i], noise[i], joint.shape[0] - m + i
            sum_root = s + root
            alpha, beta, residual = w / sum_root, w / s, mean[row]
            # mean' = mean - beta residual g;  joint' = joint - alpha g f^T
            along_mean = (mean_bar * g).sum(0)
            along_f = (joint_bar * f).sum(1)
            along_g = (joint_bar * g.unsqueeze(1)).sum(0)
            beta_bar = -residual * along_mean
            minus_alpha_bar = (g * along_f).sum(0)
            root_bar = minus_alpha_bar * alpha / sum_root
            g_bar = (mean_bar * (-beta * residual)).addcmul_(along_f, alpha, value=-1)
            # root = sqrt(r s), derivative 0 at r s = 0
            half = torch.where(r > 0, 0.5 * root_bar / root, 0.0)
            s_bar = root_bar + half * r - beta_bar * beta / s
            noise_bar[i] = s_bar + half * s
            weight_bar[i] = beta_bar / s - minus_alpha_bar / sum_root + s_bar * g[row]
            # s = w g_row + r;  g = joint f;  f = joint[row]
            g_bar[row] += w * s_bar
            f_bar = (joint * g_bar.unsqueeze(1)).sum(0).addcmul_(alpha, along_g, value=-1)
            joint_bar.addcmul_(g_bar.unsqueeze(1), f)
            joint_bar[row] += f_bar
            mean_bar[row] -= beta * along_mean
        return joint_bar, mean_bar, weight_bar, noise_bar
