"""Random measurement updates."""

from __future__ import annotations

import numpy as np
import torch
from helpers import tensor
from torch import Tensor


def random_problem(
    rng: np.random.Generator, n: int = 4, m: int = 3, batch: tuple[int, ...] = ()
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Deviations X, rows H, innovation, weights in (0.1, 1), independent noise."""
    shapes = ((*batch, n, n), (*batch, m, n), (*batch, m))
    deviations, rows, innovation = (tensor(rng.standard_normal(shape)) for shape in shapes)
    weight, noise = (tensor(rng.uniform(0.1, 1.0, (*batch, m))) for _ in range(2))
    return deviations, rows, innovation, weight, noise


def with_columns(deviations: Tensor, observed: Tensor, common: Tensor) -> tuple[Tensor, Tensor]:
    """Common noise as further columns of the observed deviations, zero in the state's."""
    padded = torch.nn.functional.pad(deviations, (0, common.shape[-1]))
    return padded, torch.cat([observed, common], dim=-1)
