"""Recovery from lock-out: when everything is rejected for long, believe the prediction less."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.core.compression import compress
from difffilter.core.conditioning import condition
from difffilter.core.cubature import halves
from difffilter.core.linalg import positive_sqrt, product, square_norms
from difffilter.core.linearised import Linearised
from difffilter.errors import InputError
from difffilter.parameters.constraints import Above, Positive
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants
from difffilter.robust.groups import spread
from difffilter.weights.weight import soft_relu

__all__ = ["RECOVERIES", "STREAK", "Recovery"]

RECOVERIES = ("widen", "inflate")
STREAK = "recovery.streak"
#: Largest logarithm of a growth, for float32.
MOST = 60.0
#: Of a prediction that knows next to nothing: its variance over squares of the innovations.
FAR = 1e4


@dataclass(frozen=True)
class Recovery:
    """After n rows in a row in which a group of channels was rejected, widen or inflate.

    A gate or a redescending weight that rejects leaves the filter to its prediction, which
    then explains the next measurement even less: a lock-out.

    The belief's memory counts rejected rows of each group (see ``scope`` of a filter): c
    becomes (c + 1)(1 - w) with w the largest weight of its present channels; a row without
    any leaves it. With n ``recovery.rejections`` and factor f ``recovery.factor``, both
    tunable:

    * ``widen``: the group's NIS is divided by f^max(0, c - n + 1) before gate and weight;
    * ``inflate``: the predicted covariance is multiplied by f in every row with c >= n: all
      of it, but for what accepted channels tell, whose groups have c = 0: with these channels'
      Z and R, P grows by ((f - 1)^-1 P^-1 + Z^T R^-1 Z)^-1.

    Either goes on until the group passes. And either only while a wrong prediction could be
    the cause: the exponent is multiplied by the weight that the group would get if the
    prediction knew next to nothing but what accepted channels tell. So one faulty channel
    among several that see the same stays rejected, and so do sensors of one group that
    contradict each other, for as long as they do. [reconstruction]

    Attributes:
        action: ``widen`` or ``inflate``.
        rejections: n, rows.
        factor: f, per row, above 1.

    Raises:
        InputError: an unknown action.
    """

    action: str = "inflate"
    rejections: float = 5.0
    factor: float = 4.0

    def __post_init__(self) -> None:
        if self.action not in RECOVERIES:
            expected = ", ".join(RECOVERIES)
            raise InputError(f"recovery: found {self.action!r}, expected one of {expected}")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Rejected rows before it begins, and the factor per row."""
        rows = "rejected rows in a row before recovery begins"
        factor = {"widen": "on the gate", "inflate": "on the predicted covariance"}[self.action]
        return (
            Parameter("recovery.rejections", self.rejections, Positive(), "rows", meaning=rows),
            Parameter(
                "recovery.factor", self.factor, Above(1.0), "1", meaning=f"factor {factor}, per row"
            ),
        )

    def memory(self, mean: Tensor, groups: int) -> dict[str, Tensor]:
        """Start of the memory: no rejected row of any group. ``mean`` (..., n)."""
        return {STREAK: mean.new_zeros(*mean.shape[:-1], groups)}

    def growth(self, streak: Tensor, constants: Constants, share: Tensor | float = 1.0) -> Tensor:
        """Factor by which a group's NIS (widen) or the covariance (inflate) changes now.

        Args:
            streak: c (..., g); share: of the exponent.
        """
        beyond = streak - constants["recovery.rejections"] + 1.0
        temperature = constants.get("temperature")

        def above(x: Tensor) -> Tensor:
            return x.clamp_min(0.0) if temperature is None else soft_relu(x, temperature)

        exponent = above(beyond)
        if self.action == "inflate":
            exponent = exponent - above(beyond - 1.0)
        logarithm = (exponent * constants["recovery.factor"].log()).clamp_max(MOST)
        return (logarithm * share).exp()

    def applied(
        self,
        streak: Tensor,
        linear: Linearised,
        present: Tensor,
        groups: Sequence[Sequence[int]],
        weights: Callable[[Linearised], Tensor],
        constants: Constants,
    ) -> tuple[Linearised, Tensor | None]:
        """The step with a grown covariance, or what gate and weights are widened by (..., m).

        Args:
            streak: (..., g), the counts; groups: indices of each group's channels.
            linear, present: the step's.
            weights: a linearised step -> the weights (..., m) that it gives.
            constants: of the filter.
        """
        told = spread(groups, list((1.0 - streak).clamp_min(0.0).unbind(-1))) * present
        share = _best(weights(_doubted(linear, present, told)), groups)
        here = torch.stack([present[..., [*group]].any(-1) for group in groups], dim=-1)
        growth = torch.where(here, self.growth(streak, constants, share), 1.0)
        if self.action == "widen":
            return linear, spread(groups, list(growth.unbind(-1)))
        return _inflated(linear, told, growth.amax(-1) - 1.0), None

    def count(
        self, streak: Tensor, weight: Tensor, present: Tensor, groups: Sequence[Sequence[int]]
    ) -> Tensor:
        """The counts (..., g) after a row with these weights and present channels (..., m)."""
        here = torch.stack([present[..., [*group]].any(-1) for group in groups], dim=-1)
        return torch.where(here, (streak + 1.0) * (1.0 - _best(weight, groups)), streak)


def _best(weight: Tensor, groups: Sequence[Sequence[int]]) -> Tensor:
    """(..., g), largest weight of each group's channels."""
    return torch.stack([weight[..., [*group]].amax(-1) for group in groups], dim=-1)


def _untold(linear: Linearised, told: Tensor, extra: Tensor) -> Tensor:
    """C (..., n, n): X C C^T X^T is what P times ``extra`` (...) keeps beside the told channels."""
    n = linear.size
    unit = torch.eye(n, dtype=extra.dtype, device=extra.device)
    root = positive_sqrt(extra)[..., None, None]
    observed = halves(linear.observed[..., : linear.own], n)
    nothing = torch.zeros_like(linear.innovation)
    return condition(unit * root, observed * root, nothing, told, linear.total).deviations


def _doubted(linear: Linearised, present: Tensor, told: Tensor) -> Linearised:
    """The step if the prediction knew next to nothing but what the told channels tell."""
    n, own = linear.size, linear.own
    observed = halves(linear.observed[..., :own], n)
    variance = square_norms(observed)
    usable = present & (variance > 0.0)
    needed = torch.where(
        usable, linear.innovation.square() / torch.where(usable, variance, 1.0), 0.0
    ).amax(-1)
    extra = (FAR * (1.0 + needed)).clamp_max(math.exp(MOST))
    c = _untold(linear, told, extra)

    def beside(columns: Tensor) -> Tensor:
        half = halves(columns[..., :own], n)
        return torch.cat([half, product(half, c), columns[..., own:]], dim=-1)

    return linear._replace(deviations=beside(linear.deviations), observed=beside(linear.observed))


def _inflated(linear: Linearised, told: Tensor, extra: Tensor) -> Linearised:
    """P grown by ``extra`` (...) times itself, but for what the told channels tell."""
    n, own = linear.size, linear.own
    c = _untold(linear, told, extra)
    unit = torch.eye(n, dtype=c.dtype, device=c.device).expand_as(c)
    factor = compress(unit, c)

    def grown(columns: Tensor) -> Tensor:
        blocks = [product(block, factor) for block in columns[..., :own].chunk(own // n, dim=-1)]
        return torch.cat([*blocks, columns[..., own:]], dim=-1)

    return linear._replace(deviations=grown(linear.deviations), observed=grown(linear.observed))
