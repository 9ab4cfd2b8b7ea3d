"""Weights that are smooth as published (student-t but for its clip): soft and hard alike."""

from __future__ import annotations

import torch
from torch import Tensor

from difffilter.parameters.constraints import Below, Positive
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants
from difffilter.weights.weight import Weight, clipping_point, soft_excess

__all__ = ["barron", "cauchy", "imq", "plain", "student_t", "welsch"]


def _plain(s: Tensor, c: Constants, temperature: Tensor | None) -> Tensor:
    return torch.ones_like(s)


def _cauchy(s: Tensor, c: Constants, temperature: Tensor | None) -> Tensor:
    return 1.0 / (1.0 + (s / c["cauchy.k"]).square())


def _welsch(s: Tensor, c: Constants, temperature: Tensor | None) -> Tensor:
    return (-0.5 * (s / c["welsch.k"]).square()).exp()


def _imq(s: Tensor, c: Constants, temperature: Tensor | None) -> Tensor:
    return 1.0 / (1.0 + (s / c["imq.k"]).square())


def _student_t(s: Tensor, c: Constants, temperature: Tensor | None) -> Tensor:
    """(nu + 1) / (nu + max(s^2, 1))."""
    top = c["student-t.nu"] + 1.0
    return top / (top + soft_excess(s.square(), 1.0, temperature))


def _barron(s: Tensor, c: Constants, temperature: Tensor | None) -> Tensor:
    """(x / b + 1)^(-b/2) with x = (s/k)^2, b = 2 - alpha; b = 0: 1; b = inf: exp(-x/2)."""
    x, b = (s / c["barron.k"]).square(), 2.0 - c["barron.alpha"]
    ordinary = (b > 0.0) & torch.isfinite(b)
    inside = torch.where(ordinary, b, 1.0)
    exponent = 0.5 * inside * (x / inside).log1p()
    limit = torch.where(b > 0.0, 0.5 * x, torch.zeros_like(x))
    return (-torch.where(ordinary, exponent, limit)).exp()


def _number(name: str, value: float, source: str, meaning: str) -> Parameter:
    return Parameter(name, value, Positive(), "1", source, meaning=meaning)


#: 1: the Kalman filter.
plain = Weight("plain", _plain)
#: 1 / (1 + (s / k)^2). ``cauchy.k`` 2.385 sigma: efficiency of 95 %.
cauchy = Weight("cauchy", _cauchy, (clipping_point("cauchy.k", 2.385, "95 % efficiency"),))
#: exp(-(s / k)^2 / 2), maximum correntropy. ``welsch.k`` 2.985 sigma, customary for exp(-(s /
#: k)^2).
welsch = Weight(
    "welsch", _welsch, (clipping_point("welsch.k", 2.985, "customary for exp(-(s/k)^2)"),)
)
#: 1 / (1 + (s / k)^2): WoLF's squared inverse multi-quadric. ``imq.k`` 3.0 sigma.
imq = Weight("imq", _imq, (clipping_point("imq.k", 3.0, "WoLF"),))
#: (nu + 1) / (nu + s^2), at most 1: Student's density. ``student-t.nu`` 4 degrees of freedom.
student_t = Weight(
    "student-t",
    _student_t,
    (_number("student-t.nu", 4.0, "customary", "degrees of freedom"),),
)
#: ((s / k)^2 / |alpha - 2| + 1)^(alpha / 2 - 1), Barron's family: alpha to 2 is ``plain``, 0
#: ``cauchy``, -2 Geman-McClure, to minus infinity ``welsch``. ``barron.alpha`` 0, ``barron.k``
#: 1.686 sigma.
barron = Weight(
    "barron",
    _barron,
    (
        Parameter(
            "barron.alpha",
            0.0,
            Below(2.0),
            source="Barron: alpha = 0 is Cauchy's",
            meaning="shape: the lower, the more is rejected (2 plain, 0 cauchy, -inf welsch)",
        ),
        clipping_point("barron.k", 1.686, "95 % efficiency at alpha = 0"),
    ),
)
