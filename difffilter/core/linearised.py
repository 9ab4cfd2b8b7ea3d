"""A predicted belief and measurement, before any weighing."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.cubature import square
from difffilter.core.innovation import innovation_variance

__all__ = ["Linearised"]


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
        again: (mean, deviations (..., n, n)) -> the same measurement linearised there, with
            the declared noise; :meth:`at` keeps the noise of this step.
    """

    mean: Tensor
    deviations: Tensor
    innovation: Tensor
    observed: Tensor
    independent: Tensor
    total: Tensor
    common: int
    moved: Tensor
    process: Tensor
    transition: Callable[[Tensor], Tensor]
    dt: Tensor
    again: Callable[[Tensor, Tensor], Linearised]

    @property
    def own(self) -> int:
        """How many of the first columns are the state's: n, or 2n with cubature."""
        return self.deviations.shape[-1] - self.common

    @property
    def factor(self) -> Tensor:
        """X (..., n, n) of the state, from cubature's 2n columns too."""
        return square(self.deviations[..., : self.own], self.size)

    @property
    def innovation_variance(self) -> Tensor:
        """(..., m), nominal variance S_ii of each innovation."""
        return innovation_variance(self.observed, self.independent)

    @property
    def size(self) -> int:
        """n, of the state's deviations."""
        return self.deviations.shape[-2]

    def at(self, mean: Tensor, deviations: Tensor) -> Linearised:
        """The same measurement linearised elsewhere, with the noise that this step has."""
        there = self.again(mean, deviations)
        if self.common:
            columns = [there.observed[..., : there.own], self.observed[..., self.own :]]
            there = there._replace(observed=torch.cat(columns, dim=-1))
        return there._replace(independent=self.independent, total=self.total)
