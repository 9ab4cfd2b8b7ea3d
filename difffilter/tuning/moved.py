"""What one step of any optimiser is given, and what it tells."""

from __future__ import annotations

from collections.abc import Callable, Mapping

from torch import Tensor

from difffilter.tuning.curvature import Expansion

__all__ = ["Evaluate", "Expand", "Moved"]

#: The loss and its terms of the current values at a temperature (None: the hard form),
#: differentiable.
Evaluate = Callable[[float | None], tuple[Tensor, Mapping[str, Tensor]]]
#: The same to second order.
Expand = Callable[[float], Expansion]


class Moved:
    """What one step did: the loss before it, its terms, the norm of its gradient."""

    def __init__(self, loss: float, terms: Mapping[str, Tensor], norm: float) -> None:
        self.loss, self.terms, self.norm = loss, terms, norm
