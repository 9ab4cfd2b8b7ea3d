"""Residuals in sigmas: what weights and gates see of a step, channel by channel or by group."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from difffilter.core.linalg import positive_sqrt
from difffilter.core.linearised import Linearised
from difffilter.errors import InputError
from difffilter.robust.groups import DISTANCES, group_rms, normalised_square, spread

__all__ = ["STANDARDISATIONS", "GateTest", "Residuals", "Scales"]

STANDARDISATIONS = ("innovation", "noise")


class Scales(NamedTuple):
    """What residuals are measured with.

    nominal: (..., m), innovation variance S_ii; per_sigma: (..., m), divides residuals;
    widening: (..., m) or None.
    """

    nominal: Tensor
    per_sigma: Tensor
    widening: Tensor | None


class GateTest(NamedTuple):
    """What the gate asks of each channel: NIS of its group, its degrees, R_ii / S_ii (..., m)."""

    nis: Tensor
    degrees: Tensor | None
    share: Tensor


@dataclass(frozen=True)
class Residuals:
    """How residuals are standardised, and how far a group of channels is off.

    Attributes:
        standardise, distance: as for :class:`difffilter.Filter`.
        groups: indices of the channels that share one weight and one gate; None where each
            channel is by itself.

    Raises:
        InputError: an unknown option.
    """

    standardise: str = "innovation"
    distance: str = "rms"
    groups: tuple[tuple[int, ...], ...] | None = None

    def __post_init__(self) -> None:
        if self.standardise not in STANDARDISATIONS:
            expected = " or ".join(STANDARDISATIONS)
            raise InputError(f"standardise: found {self.standardise!r}, expected {expected}")
        if self.distance not in DISTANCES:
            expected = " or ".join(DISTANCES)
            raise InputError(f"distance: found {self.distance!r}, expected {expected}")

    def scales(self, linear: Linearised, widening: Tensor | None = None) -> Scales:
        """Of a step; ``widening`` (..., m) divides every NIS."""
        nominal = linear.innovation_variance
        variance = nominal if self.standardise == "innovation" else linear.total
        if widening is not None:
            variance = variance * widening
        return Scales(nominal, variance.rsqrt(), widening)

    def distances(
        self, linear: Linearised, residual: Tensor, present: Tensor, scales: Scales
    ) -> Tensor:
        """(..., m), residuals in sigmas as the weight function sees them: one per group."""
        s = residual * scales.per_sigma
        if self.groups is None:
            return s
        if self.distance == "rms":
            return spread(self.groups, [group_rms(s, present, g) for g in self.groups])
        observed = linear.observed
        if self.standardise == "noise":
            observed = observed[..., linear.own :]
        return positive_sqrt(self._squares(linear, residual, observed, present, scales.widening))

    def _squares(
        self,
        linear: Linearised,
        residual: Tensor,
        observed: Tensor,
        present: Tensor,
        widening: Tensor | None,
    ) -> Tensor:
        """(..., m), e^T (Z Z^T + diag r)^-1 e of each channel's group."""
        groups = self.groups or ()
        squares = spread(
            groups,
            [
                normalised_square(residual, observed, linear.independent, present, group)
                for group in groups
            ],
        )
        return squares if widening is None else squares / widening

    def test(self, linear: Linearised, present: Tensor, scales: Scales) -> GateTest:
        """From the nominal innovation."""
        share = linear.total / scales.nominal
        if self.groups is None:
            nis = linear.innovation.square() / scales.nominal
            if scales.widening is not None:
                nis = nis / scales.widening
            return GateTest(nis, None, share)
        nis = self._squares(linear, linear.innovation, linear.observed, present, scales.widening)
        counts = [present[..., [*group]].sum(-1) for group in self.groups]
        return GateTest(nis, spread(self.groups, counts), share)
