"""What a plug-in around predict and condition fulfils."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from torch import Tensor

from difffilter.core.equations import Conditioned
from difffilter.core.linearised import Linearised
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants

__all__ = ["Adaptation"]


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
        constants: Constants,
    ) -> Tensor:
        """Adapt the deviations (..., n, q) of the process noise."""

    def before_condition(
        self,
        memory: Mapping[str, Tensor],
        linearised: Linearised,
        present: Tensor,
        inputs: Mapping[str, Tensor],
        constants: Constants,
    ) -> tuple[Linearised, Mapping[str, Tensor]]:
        """Adapt the linearised step; returns it with the new memory."""

    def after_condition(
        self,
        memory: Mapping[str, Tensor],
        linearised: Linearised,
        conditioned: Conditioned,
        weight: Tensor,
        present: Tensor,
        constants: Constants,
    ) -> Mapping[str, Tensor]:
        """New memory, from what the update did with the final weights (..., m)."""
