"""Weights with clipping points: full information up to a bound, less or none beyond."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import softplus

from difffilter.parameters.parameters import Values
from difffilter.parameters.values import Constants
from difffilter.weights.weight import (
    Weight,
    clipping_pair,
    clipping_point,
    soft_abs,
    soft_excess,
    soft_relu,
)

__all__ = ["danish", "huber", "igg3", "tanh", "tukey"]


def _huber_with(s: Tensor, k: Tensor, temperature: Tensor | None) -> Tensor:
    """min(1, k / |s|), through s^2 so that s = 0 is a smooth point."""
    square, k2 = s.square(), k.square()
    if temperature is None:
        return k / torch.maximum(square, k2).sqrt()
    return k / (k2 + soft_excess(square, k2, temperature)).sqrt()


def _huber(s: Tensor, c: Constants, temperature: Tensor | None) -> Tensor:
    return _huber_with(s, c["huber.k"], temperature)


def _igg3(s: Tensor, c: Constants, temperature: Tensor | None) -> Tensor:
    """Huber's weight at k0 times the square of a ramp from 1 at k0 to 0 at k1."""
    k0, k1 = c["igg3.k"][..., 0], c["igg3.k"][..., 1]
    core = _huber_with(s, k0, temperature)
    if temperature is None:
        ramp = ((k1 - s.abs()) / (k1 - k0)).clamp(0.0, 1.0)
        return core * ramp.square()
    # Soft ramp: difference of two soft steps, scaled to be exactly 1 at s = 0.
    at_zero = _soft_step(torch.zeros_like(k0), k0, k1, temperature)
    rest = _soft_step(temperature * soft_abs(s / temperature), k0, k1, temperature)
    rest = (rest - at_zero) / (1.0 - at_zero)
    return core * (1.0 - rest).clamp_min(0.0).square()


def _soft_step(x: Tensor, low: Tensor, high: Tensor, temperature: Tensor) -> Tensor:
    """Ramp from 0 below ``low`` to 1 above ``high``."""
    rise = soft_relu(x - low, temperature) - soft_relu(x - high, temperature)
    return rise / (high - low)


def _tanh(s: Tensor, c: Constants, temperature: Tensor | None) -> Tensor:
    """psi(s) / s with the redescending psi of paper 3, eq. (25)."""
    slope, b = c["tanh.c"], c["tanh.ab"][..., 1]
    if temperature is None:
        size = s.abs()
        psi = slope * torch.tanh(0.5 * slope * (b - size).clamp_min(0.0))
        inside = size < c["tanh.ab"][..., 0]
        return torch.where(inside, 1.0, psi / torch.where(inside, 1.0, size))
    # All in units of the temperature.
    slope, b, half = slope / temperature, b / temperature, 0.5 * slope * temperature
    size = soft_abs(s / temperature)
    psi = slope * torch.tanh(half * softplus(b - size, threshold=40.0))
    psi0 = slope * torch.tanh(half * softplus(b, threshold=40.0))
    excess = softplus(size - psi, threshold=40.0) - softplus(-psi0, threshold=40.0)
    return psi / (psi + excess)


def _tanh_slope(values: Values) -> dict[str, Tensor]:
    """c > 0 with a = c tanh(c (b - a) / 2): psi is continuous at a.

    Newton's method without gradient; one more step with it gives the implicit-function
    derivative of c towards a and b.
    """
    a, b = values["tanh.ab"][..., 0], values["tanh.ab"][..., 1]

    def newton(c: Tensor, a: Tensor, b: Tensor) -> Tensor:
        half = 0.5 * (b - a)
        t = torch.tanh(c * half)
        return c - (c * t - a) / (t + c * half * (1.0 - t.square()))

    with torch.no_grad():
        fixed_a, fixed_b = a.detach(), b.detach()
        # Right of the root, where c tanh(.) is convex or increasing: monotone descent.
        c = fixed_a + (2.0 * fixed_a / (fixed_b - fixed_a)).sqrt()
        for _ in range(60):
            c = newton(c, fixed_a, fixed_b)
    return {"tanh.c": newton(c, a, b)}


def _danish(s: Tensor, c: Constants, temperature: Tensor | None) -> Tensor:
    """exp(1 - (s/k)^2) beyond k."""
    return (-soft_excess((s / c["danish.k"]).square(), 1.0, temperature)).exp()


def _tukey(s: Tensor, c: Constants, temperature: Tensor | None) -> Tensor:
    """Square of a ramp in (s/k)^2, from 1 at s = 0 to 0 at k."""
    left = 1.0 - (s / c["tukey.k"]).square()
    if temperature is None:
        return left.clamp_min(0.0).square()
    return (soft_relu(left, temperature) / soft_relu(torch.ones_like(left), temperature)).square()


#: min(1, k / |s|). ``huber.k`` 1.345 sigma: efficiency of 95 % for Gaussian noise (Huber).
huber = Weight("huber", _huber, (clipping_point("huber.k", 1.345, "Huber"),))
#: 1 up to k0, (k0 / |s|) ((k1 - |s|) / (k1 - k0))^2 up to k1, 0 beyond. ``igg3.k`` (1.2, 4.0)
#: sigma: IGG-III (paper 1, which calls them k1 and k2).
igg3 = Weight("igg3", _igg3, (clipping_pair("igg3.k", (1.2, 4.0), ("k0", "k1"), "paper 1"),))
#: 1 up to a, c tanh(c (b - |s|) / 2) / |s| up to b, 0 beyond, c such that it is continuous (paper
#: 3, eq. 25). ``tanh.ab`` (1.5, 4.0) sigma, calibrated: the paper leaves them open.
tanh = Weight(
    "tanh",
    _tanh,
    (clipping_pair("tanh.ab", (1.5, 4.0), ("a", "b"), "calibrated; paper 3 leaves them open"),),
    _tanh_slope,
)
#: 1 up to k, exp(1 - (s / k)^2) beyond: the Danish method of geodesy. ``danish.k`` 2.0 sigma.
danish = Weight("danish", _danish, (clipping_point("danish.k", 2.0, "Danish method"),))
#: (1 - (s / k)^2)^2 up to k, 0 beyond. ``tukey.k`` 4.685 sigma: efficiency of 95 % (Tukey).
tukey = Weight("tukey", _tukey, (clipping_point("tukey.k", 4.685, "Tukey, 95 % efficiency"),))
