"""A predicted belief and measurement, and the plug-ins that may adapt them."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

from torch import Tensor

from difffilter.condition import Conditioned
from difffilter.parameters import Parameter, Values

__all__ = ["Adaptation", "Linearised"]


class Linearised(NamedTuple):
    """A predicted belief and measurement, before any weighing.

    Attributes:
        mean: (..., n) predicted mean; deviations: (..., n, k) with k >= n.
        innovation: (..., m); 0 where missing.
        observed: (..., m, k) deviations of the predicted measurement.
        independent: (..., m) independent noise variance.
        total: (..., m) diagonal of R.
        common: how many of the last columns are noise common to channels.
        moved: (..., n, j) moved deviations F X without process noise; process: (..., n, q).
        transition: columns (..., n, j) -> F times them, F the motion's Jacobian.
        dt: (...), s, of the prediction.
        again: (mean, deviations (..., n, n)) -> the same measurement linearised there.
    """

    mean: Tensor
    deviations: Tensor
    innovation: Tensor
    observed: Tensor
    independent: Tensor
    total: Tensor
    common: int = 0
    moved: Tensor | None = None
    process: Tensor | None = None
    transition: Callable[[Tensor], Tensor] | None = None
    dt: Tensor | None = None
    again: Callable[[Tensor, Tensor], Linearised] | None = None

    @property
    def own(self) -> int:
        """How many of the first columns are the state's: n, or 2n with cubature."""
        return self.deviations.shape[-1] - self.common


class Adaptation(Protocol):
    """A plug-in around predict and condition, with memory carried in the belief.

    Each hook is pure and of static shape, like the step.
    """

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Declared parameters."""

    def memory(self, mean: Tensor, channels: int) -> dict[str, Tensor]:
        """Start value of the memory, with the leading dimensions of ``mean``."""

    def before_predict(
        self,
        memory: Mapping[str, Tensor],
        process: Tensor,
        inputs: Mapping[str, Tensor],
        constants: Values,
    ) -> Tensor:
        """Adapt the deviations (..., n, q) of the process noise."""

    def before_condition(
        self,
        memory: Mapping[str, Tensor],
        linearised: Linearised,
        present: Tensor,
        inputs: Mapping[str, Tensor],
        constants: Values,
    ) -> tuple[Linearised, Mapping[str, Tensor]]:
        """Adapt the linearised step; returns it with the new memory."""

    def after_condition(
        self,
        memory: Mapping[str, Tensor],
        linearised: Linearised,
        conditioned: Conditioned,
        weight: Tensor,
        present: Tensor,
        constants: Values,
    ) -> Mapping[str, Tensor]:
        """New memory, from what the update did with the final weights (..., m)."""
