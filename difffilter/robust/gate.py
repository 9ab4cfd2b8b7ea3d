"""The chi-square gate on the normalised innovation squared (NIS) of a channel or a group."""

from __future__ import annotations

from dataclasses import dataclass
from statistics import NormalDist

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants
from difffilter.robust.chi_square import equivalent_thresholds

__all__ = ["ACTIONS", "Gate"]

ACTIONS = ("reject", "reweigh", "inflate")


@dataclass(frozen=True)
class Gate:
    """Chi-square test of the NIS e = nu^T S^-1 nu over the present channels of a group.

    Attributes:
        action: what a failed test does: ``reject`` (w = 0), ``reweigh`` (the filter's
            robust weight instead of 1, paper 1), ``inflate`` (R grows by (e / threshold - 1)
            times the diagonal of S: for one channel, until e is down at the threshold).
        significance: of the published threshold; 0.005 is paper 1's, with 7.879 for one
            channel. The parameter ``gate.threshold`` is that of one degree of freedom; a
            group of d present channels is tested at the same significance with d.

    Raises:
        InputError: an unknown action, a significance that is not between 0 and 1.
    """

    action: str = "reject"
    significance: float = 0.005

    def __post_init__(self) -> None:
        if self.action not in ACTIONS:
            raise InputError(f"gate: found {self.action!r}, expected one of {', '.join(ACTIONS)}")
        if not 0.0 < self.significance < 1.0:
            raise InputError(f"significance: found {self.significance}, expected between 0 and 1")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """The threshold for one degree of freedom, in squared sigmas."""
        meaning = "NIS above which one channel fails the gate"
        source = f"chi-square at {self.significance:g}, 1 degree of freedom"
        if self.significance == 0.005:
            source = f"paper 1: {source}"
        quantile = NormalDist().inv_cdf(0.5 * self.significance) ** 2
        return (Parameter("gate.threshold", quantile, Positive(), "1", source, meaning=meaning),)

    def prepare(self, values: Values, most: int = 1) -> dict[str, Tensor]:
        """``gate.thresholds`` (most,): for 1 to ``most`` degrees of freedom."""
        return {"gate.thresholds": equivalent_thresholds(values["gate.threshold"], most)}

    def weigh(
        self,
        weight: Tensor,
        nis: Tensor,
        degrees: Tensor | None,
        constants: Constants,
        temperature: Tensor | None,
        share: Tensor | float = 1.0,
    ) -> tuple[Tensor, Tensor]:
        """Combine the robust ``weight`` with the test: (weight, passed), each (..., m).

        Args:
            weight: (..., m), of each channel.
            nis: (..., m), of each channel's group.
            degrees: (..., m), present channels of that group; None where all are 1.
            constants: with ``gate.thresholds`` from :meth:`prepare`.
            temperature: None for the hard test: 1 up to the threshold, 0 beyond; else the
                sigmoid((threshold - e) / temperature).
            share: R_ii / S_ii (..., m): what of the innovation variance a weight inflates.
        """
        thresholds: Tensor = constants["gate.thresholds"]
        if degrees is None:
            threshold = thresholds[0]
        else:
            threshold = thresholds[(degrees.long() - 1).clamp_min(0)]
        if temperature is None:
            passed = (nis <= threshold).to(nis.dtype)
        else:
            passed = torch.sigmoid((threshold - nis) / temperature)
        if self.action == "reject":
            return passed * weight, passed
        if self.action == "reweigh":
            return passed + (1.0 - passed) * weight, passed
        excess = (nis / threshold - 1.0).clamp_min(0.0)
        inflated = share / (share + excess)
        return (passed + (1.0 - passed) * inflated) * weight, passed
