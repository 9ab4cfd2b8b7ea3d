"""Weight functions w(s): each multiplies one channel's information (R -> R / w).

``s`` is a standardised residual. Every function has the published (hard) form, used when
``temperature`` is None, and a soft form for training, smooth in s and in its parameters,
that converges to the hard one as the temperature goes to 0. A new robust filter is a new
function here, wrapped in a :class:`Weight`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import softplus

from difffilter.constraints import OrderedPair, Positive
from difffilter.errors import InputError
from difffilter.parameters import Parameter, Values

__all__ = ["WEIGHTS", "Weight", "huber", "igg3", "imq", "plain", "tanh", "weight_named"]

WeightFunction = Callable[[Tensor, Values, Tensor | None], Tensor]


@dataclass(frozen=True)
class Weight:
    """A weight function with the parameters that it declares.

    Attributes:
        name: as in scenario files and checkpoints.
        function: (s, constants, temperature or None) -> w, elementwise on s (..., m).
        parameters: declarations; their values arrive in ``constants`` by name.
        derive: further constants computed once per run from the values.
    """

    name: str
    function: WeightFunction
    parameters: tuple[Parameter, ...] = ()
    derive: Callable[[Values], dict[str, Tensor]] | None = None

    def __call__(self, s: Tensor, constants: Values, temperature: Tensor | None = None) -> Tensor:
        """w(s) in [0, 1]; ``constants`` from :meth:`prepare`."""
        return self.function(s, constants, temperature)

    def prepare(self, values: Values) -> dict[str, Tensor]:
        """Values and derived constants that the function reads."""
        constants = {p.name: values[p.name] for p in self.parameters}
        return constants | (self.derive(values) if self.derive else {})


def soft_relu(x: Tensor, temperature: Tensor) -> Tensor:
    """temperature * log(1 + exp(x / temperature)): max(x, 0) as the temperature -> 0."""
    return temperature * softplus(x / temperature, threshold=40.0)


def soft_abs(s: Tensor) -> Tensor:
    """Smooth |s|: even, 0 at 0, below |s| by at most a half."""
    return (s.square() + 0.25).sqrt() - 0.5


def _plain(s: Tensor, c: Values, temperature: Tensor | None) -> Tensor:
    return torch.ones_like(s)


def _huber_with(s: Tensor, k: Tensor, temperature: Tensor | None) -> Tensor:
    """min(1, k / |s|), through s^2 so that s = 0 is a smooth point."""
    square, k2 = s.square(), k.square()
    if temperature is None:
        return k / torch.maximum(square, k2).sqrt()
    excess = soft_relu(square - k2, temperature) - soft_relu(-k2, temperature)
    return k / (k2 + excess).sqrt()


def _huber(s: Tensor, c: Values, temperature: Tensor | None) -> Tensor:
    return _huber_with(s, c["huber.k"], temperature)


def _igg3(s: Tensor, c: Values, temperature: Tensor | None) -> Tensor:
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


def _tanh(s: Tensor, c: Values, temperature: Tensor | None) -> Tensor:
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


def _imq(s: Tensor, c: Values, temperature: Tensor | None) -> Tensor:
    return 1.0 / (1.0 + (s / c["imq.k"]).square())


def _clip(name: str, value: float, source: str) -> Parameter:
    return Parameter(name, value, Positive(), "sigma", source, meaning="clipping point")


def _pair(name: str, value: tuple[float, float], labels: tuple[str, str], source: str) -> Parameter:
    meaning = f"clipping points {labels[0]} < {labels[1]}"
    return Parameter(name, value, OrderedPair(), "sigma", source, labels=labels, meaning=meaning)


plain = Weight("plain", _plain)
huber = Weight("huber", _huber, (_clip("huber.k", 1.345, "Huber"),))
igg3 = Weight("igg3", _igg3, (_pair("igg3.k", (1.2, 4.0), ("k0", "k1"), "paper 1"),))
tanh = Weight(
    "tanh",
    _tanh,
    (_pair("tanh.ab", (1.5, 4.0), ("a", "b"), "calibrated; paper 3 leaves them open"),),
    _tanh_slope,
)
imq = Weight("imq", _imq, (_clip("imq.k", 3.0, "WoLF"),))

#: Every weight function by name.
WEIGHTS = {weight.name: weight for weight in (plain, huber, igg3, tanh, imq)}


def weight_named(name: str) -> Weight:
    """The weight function of that name; InputError if there is none."""
    if name not in WEIGHTS:
        raise InputError(f"weight: found {name!r}, expected one of {', '.join(WEIGHTS)}")
    return WEIGHTS[name]
