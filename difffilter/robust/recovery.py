"""Recovery from lock-out: when everything is rejected for long, believe the prediction less."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.core.linearised import Linearised
from difffilter.errors import InputError
from difffilter.parameters.constraints import Above, Positive
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants
from difffilter.weights.weight import soft_relu

__all__ = ["RECOVERIES", "STREAK", "Recovery"]

RECOVERIES = ("widen", "inflate")
STREAK = "recovery.streak"


@dataclass(frozen=True)
class Recovery:
    """After n rows in a row in which every channel was rejected, widen or inflate.

    A gate or a redescending weight that rejects everything leaves the filter to its
    prediction, which then explains the next measurement even less: a lock-out.

    The belief's memory counts rejected rows: c becomes (c + 1)(1 - w) with w the largest
    weight of the row's present channels, so that one accepted channel ends the count, and
    nothing happens in a row without measurements. With n ``recovery.rejections`` and factor f
    ``recovery.factor``, both tunable:

    * ``widen``: every NIS is divided by f^max(0, c - n + 1) before gate and weight see it;
    * ``inflate``: the predicted covariance is multiplied by f in every row with c >= n.

    Either grows until a measurement passes. [reconstruction]

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

    def memory(self, mean: Tensor) -> dict[str, Tensor]:
        """Start of the memory: no rejected row. ``mean`` (..., n)."""
        return {STREAK: torch.zeros_like(mean[..., 0])}

    def growth(self, streak: Tensor, constants: Constants) -> Tensor:
        """Factor (...) by which the NIS (widen) or the covariance (inflate) changes now."""
        beyond = streak - constants["recovery.rejections"] + 1.0
        temperature = constants.get("temperature")

        def above(x: Tensor) -> Tensor:
            return x.clamp_min(0.0) if temperature is None else soft_relu(x, temperature)

        exponent = above(beyond)
        if self.action == "inflate":
            exponent = exponent - above(beyond - 1.0)
        growth: Tensor = constants["recovery.factor"] ** exponent
        return growth

    def applied(
        self, streak: Tensor, linear: Linearised, constants: Constants
    ) -> tuple[Linearised, Tensor | None]:
        """The predicted covariance grown, or the factor by which gate and weights are widened."""
        growth = self.growth(streak, constants)
        if self.action == "widen":
            return linear, growth
        columns = growth.sqrt().unsqueeze(-1).expand(*growth.shape, linear.own)
        columns = torch.nn.functional.pad(columns, (0, linear.common), value=1.0).unsqueeze(-2)
        grown = linear._replace(
            deviations=linear.deviations * columns, observed=linear.observed * columns
        )
        return grown, None

    def count(self, streak: Tensor, weight: Tensor, present: Tensor) -> Tensor:
        """The count after a row with these weights and present channels (..., m)."""
        rejected = (streak + 1.0) * (1.0 - weight.amax(-1))
        return torch.where(present.any(-1), rejected, streak)
