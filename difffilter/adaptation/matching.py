"""Innovation-covariance matching: R raised where innovations are too large (paper 4, robust)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.adaptation.passive import Memory, Passive
from difffilter.core.linearised import Linearised
from difffilter.errors import InputError
from difffilter.parameters.constraints import Interval, Positive
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants

__all__ = ["BEFORE", "FLAG", "MATCHED", "InnovationMatching"]

RING, MATCHED, FLAG = "matching.ring", "matching.streak", "matching.flag"
#: The streak before the last row.
BEFORE = "matching.before"


@dataclass(frozen=True)
class InnovationMatching(Passive):
    """R such that the innovations' variance is what it is, where that is far too large.

    Per channel, e the innovation, P_zz its theoretical variance and c the last w - 1 entries::

        C    = a e^2 + (1 - a) mean(c)            a = 1/w, w = 4 [R]
        flag if sum C > beta (1 + m)^2 tr P_zz    beta = 9 [P], m flagged rows just before [R]
        R   <- max(R, C - (P_zz - R)) if flagged  [L, clamp R]
        c   <- e^2, or P_zz if flagged            [R]

    over the present channels. The threshold grows with m so that a lasting change is believed
    in the end. Parameters: ``matching.beta``, and ``matching.rate`` a, the window as an
    exponential rate. In training the flag is a sigmoid of the excess relative to the threshold
    over the temperature. Paper 4, robust SRCKF: [P] stated there, [L] literature,
    [R] reconstruction.

    Attributes:
        window: w, rows, 2 or more; static, of the memory.

    Raises:
        InputError: a window below 2.

    Memory: ``matching.ring`` (..., w - 1, m), c over P_zz at its row; ``matching.streak`` (...);
    ``matching.flag`` (...), of the last row; ``matching.before`` (...), the streak before it.
    """

    window: int = 4

    def __post_init__(self) -> None:
        if self.window < 2:
            raise InputError(f"matching window: found {self.window}, expected 2 or more")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """beta and the rate."""
        return (
            Parameter(
                "matching.beta", 9.0, Positive(), "1", "paper 4", meaning="threshold of the flag"
            ),
            Parameter(
                "matching.rate",
                1.0 / self.window,
                Interval(),
                "1",
                "reconstruction: window 4",
                meaning="share of the newest innovation in the actual variance",
            ),
        )

    def memory(self, mean: Tensor, channels: int) -> dict[str, Tensor]:
        """History at the theoretical variance, nothing flagged."""
        lead = mean.shape[:-1]
        return {
            RING: mean.new_full((*lead, self.window - 1, channels), torch.nan),
            MATCHED: mean.new_zeros(lead),
            FLAG: mean.new_zeros(lead),
            BEFORE: mean.new_zeros(lead),
        }

    def before_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        present: Tensor,
        inputs: Memory,
        constants: Constants,
    ) -> tuple[Linearised, Memory]:
        """R raised where the row is flagged; the history goes on."""
        variance = linearised.innovation_variance
        square = linearised.innovation.square()
        # Before the first rows the history is the theoretical variance of now.
        ring = torch.where(torch.isnan(memory[RING]), variance.unsqueeze(-2), memory[RING])
        rate, streak = constants["matching.rate"], memory[MATCHED]
        actual = rate * square + (1.0 - rate) * ring.mean(-2)
        total = torch.where(present, actual, 0.0).sum(-1)
        threshold = torch.where(present, variance, 0.0).sum(-1)
        threshold = constants["matching.beta"] * (1.0 + streak).square() * threshold
        measured = present.any(-1)
        temperature = constants.get("temperature")
        if temperature is None:
            flag = (total > threshold).to(square.dtype)
        else:
            excess = total / torch.where(measured, threshold, 1.0) - 1.0
            flag = torch.sigmoid(excess / temperature)
        flag = torch.where(measured, flag, 0.0)
        independent, total_r = linearised.independent, linearised.total
        raised = torch.maximum(independent, actual - (variance - independent))
        extra = flag.unsqueeze(-1) * (raised - independent)
        adapted = linearised._replace(independent=independent + extra, total=total_r + extra)
        entry = flag.unsqueeze(-1) * variance + (1.0 - flag.unsqueeze(-1)) * square
        entry = torch.where(present, entry, variance)
        moved = torch.cat([ring[..., 1:, :], entry.unsqueeze(-2)], dim=-2)
        new = {
            RING: torch.where(measured[..., None, None], moved, memory[RING]),
            MATCHED: torch.where(measured, (streak + 1.0) * flag, streak),
            FLAG: flag,
            BEFORE: streak,
        }
        return adapted, {**memory, **new}
