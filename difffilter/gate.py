"""The chi-square gate on the normalised innovation squared (NIS) of a channel."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.constraints import Positive
from difffilter.errors import InputError
from difffilter.parameters import Parameter, Values

__all__ = ["ACTIONS", "Gate"]

ACTIONS = ("reject", "reweigh", "inflate")

#: 0.995 quantile of chi-square with one degree of freedom: significance 0.005 (paper 1).
CHI_SQUARE_0995 = 7.879438576622417


@dataclass(frozen=True)
class Gate:
    """Chi-square test of each channel's NIS e = nu^2 / S_ii, one degree of freedom.

    Attributes:
        action: what a failed test does: ``reject`` (w = 0), ``reweigh`` (the filter's
            robust weight instead of 1, paper 1), ``inflate`` (R_ii is inflated until e is
            down at the threshold).
    """

    action: str = "reject"

    def __post_init__(self) -> None:
        if self.action not in ACTIONS:
            raise InputError(f"gate: found {self.action!r}, expected one of {', '.join(ACTIONS)}")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The threshold, in squared sigmas; default at significance 0.005."""
        meaning = "NIS above which a channel fails the gate"
        source = "paper 1: chi-square at 0.005, 1 degree of freedom"
        return (
            Parameter("gate.threshold", CHI_SQUARE_0995, Positive(), "1", source, meaning=meaning),
        )

    def passed(self, nis: Tensor, constants: Values, temperature: Tensor | None) -> Tensor:
        """1 where the test passes, 0 where it fails; a sigmoid between when soft."""
        threshold = constants["gate.threshold"]
        if temperature is None:
            return (nis <= threshold).to(nis.dtype)
        return torch.sigmoid((threshold - nis) / temperature)

    def weigh(
        self,
        weight: Tensor,
        nis: Tensor,
        constants: Values,
        temperature: Tensor | None,
        share: Tensor | float = 1.0,
    ) -> tuple[Tensor, Tensor]:
        """Combine the robust ``weight`` (..., m) with the test: (weight, passed).

        ``share`` is R_ii / S_ii (..., m): what of the innovation variance a weight inflates.
        """
        passed = self.passed(nis, constants, temperature)
        if self.action == "reject":
            return passed * weight, passed
        if self.action == "reweigh":
            return passed + (1.0 - passed) * weight, passed
        threshold = constants["gate.threshold"]
        excess = (nis / threshold - 1.0).clamp_min(0.0)
        inflated = share / (share + excess)
        return (passed + (1.0 - passed) * inflated) * weight, passed
