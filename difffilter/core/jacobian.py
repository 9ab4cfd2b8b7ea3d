"""Taylor linearisation: a predicted measurement and its deviations."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

__all__ = ["jacobian_times"]


def jacobian_times(function: Callable[[Tensor], Tensor], mean: Tensor, columns: Tensor) -> Tensor:
    """J(mean) @ columns by forward-mode differentiation, without forming J.

    Args:
        function: (..., n) -> (..., m), written for any leading dimensions.
        mean: (..., n).
        columns: (..., n, k).

    Returns:
        (..., m, k), differentiable towards mean and columns.
    """

    def along(column: Tensor) -> Tensor:
        tangent: Tensor = torch.func.jvp(function, (mean,), (column,))[1]
        return tangent

    out: Tensor = torch.func.vmap(along, in_dims=-1, out_dims=-1)(columns)
    return out
