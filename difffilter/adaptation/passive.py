"""What an adaptation does where it does nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.core.cubature import halves
from difffilter.core.equations import Conditioned
from difffilter.core.linearised import Linearised
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants

__all__ = ["Memory", "Passive", "jacobian"]

Memory = Mapping[str, Tensor]


@dataclass(frozen=True)
class Passive:
    """Base of adaptations: no parameters, no memory, hooks that change nothing."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Declared parameters."""
        return ()

    def memory(self, mean: Tensor, channels: int) -> dict[str, Tensor]:
        """Start of the memory."""
        return {}

    def before_predict(
        self, memory: Memory, process: Tensor, inputs: Memory, constants: Constants
    ) -> Tensor:
        """Deviations of the process noise, as they are."""
        return process

    def before_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        present: Tensor,
        inputs: Memory,
        constants: Constants,
    ) -> tuple[Linearised, Memory]:
        """The linearised step, as it is."""
        return linearised, memory

    def after_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        conditioned: Conditioned,
        weight: Tensor,
        present: Tensor,
        constants: Constants,
    ) -> Memory:
        """The memory, as it is."""
        return memory


def jacobian(linear: Linearised, right: Tensor) -> Tensor:
    """H times columns: (..., n, j) -> (..., m, j).

    H = (P^-1 P_xz)^T is the Jacobian, or with cubature the statistical one; X is the lower
    triangular factor of P. Where a pivot of X is 0 its column is too, and any divisor does.
    """
    n = linear.mean.shape[-1]
    factor = halves(linear.deviations[..., : linear.own], n)
    observed = halves(linear.observed[..., : linear.own], n)
    pivots = factor.diagonal(dim1=-2, dim2=-1)
    factor = factor + torch.diag_embed(torch.where(pivots == 0.0, 1.0, 0.0))
    solved: Tensor = torch.linalg.solve_triangular(factor, right, upper=False)
    return observed @ solved
