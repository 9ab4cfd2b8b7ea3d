"""Federated form: local filters with shares of the prior, fused and reset at every step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.core.conditioning import condition
from difffilter.core.equations import Conditioned
from difffilter.core.linalg import product
from difffilter.core.merge import merged_estimate
from difffilter.errors import InputError
from difffilter.parameters.values import Constants

__all__ = ["Federation"]


@dataclass(frozen=True)
class Federation:
    """N local filters, one for each system of channels; fusion-reset (paper 2).

    With shares beta_i of the information, whose sum is 1, local filter i starts each step from
    x and P / beta_i, predicts with Q / beta_i and conditions on its own system's channels.
    Fusion: P = (sum P_i^-1)^-1, x = P sum P_i^-1 x_i; then every local filter is reset to x.

    **The fused estimate does not depend on the shares**: sum beta_i P^-1 + sum C_i^T R_i^-1 C_i.
    They are part of the recipe, to show just that, and no parameter: nothing could tune them.

    The local filters are one more leading dimension of the same :func:`condition`, in the
    coordinates in which the prior is I / beta_i, so that a singular P passes. Fusing is the
    same update again: each local estimate is a measurement of the state, with its full
    covariance in the common columns.

    A system whose prediction or measurement is not finite is isolated for that step: its
    local filter keeps the prior (see ``Record.isolated``).

    Attributes:
        shares: beta_i, one for each system.
        members: indices of the channels of each system.

    Raises:
        InputError: fewer than two shares, one that is not above 0, a sum that is not 1.
    """

    shares: tuple[float, ...]
    members: tuple[tuple[int, ...], ...] = ()

    def __post_init__(self) -> None:
        positive = all(share > 0.0 for share in self.shares)  # False for NaN
        if len(self.shares) < 2 or not positive or abs(sum(self.shares) - 1) > 1e-9:
            raise InputError(
                f"shares: found {list(self.shares)}, expected two or more above 0 whose sum is 1"
            )

    @property
    def systems(self) -> int:
        """How many local filters."""
        return len(self.shares)

    def prepare(self, dtype: torch.dtype) -> dict[str, Tensor]:
        """``federation.root`` (N,), 1 / sqrt(beta), and ``federation.member`` (N, m): 1 where a
        channel belongs to a system."""
        member = torch.zeros(self.systems, sum(map(len, self.members)), dtype=dtype)
        for i, system in enumerate(self.members):
            member[i, [*system]] = 1.0
        root = torch.tensor(self.shares, dtype=dtype).rsqrt()
        return {"federation.root": root, "federation.member": member}

    def condition(
        self,
        rows: Tensor,
        observed: Tensor,
        innovation: Tensor,
        weight: Tensor,
        noise: Tensor,
        constants: Constants,
    ) -> Conditioned:
        """What :func:`difffilter.condition` does, by local filters and fusion.

        Args:
            rows: (..., n, k) deviations; observed: (..., m, k); innovation, weight, noise:
                (..., m), as for :func:`difffilter.condition`.
            constants: from :meth:`prepare`.
        """
        k = rows.shape[-1]
        lead = innovation.shape[:-1]
        # One leading dimension of systems: deviations of the whitened prior, I / sqrt(beta).
        root = constants["federation.root"].reshape(-1, *[1] * (len(lead) + 2))
        unit = torch.eye(k, dtype=rows.dtype, device=rows.device).expand(*lead, k, k)
        own = constants["federation.member"].reshape(self.systems, *[1] * len(lead), -1)
        local = condition(
            unit * root,
            observed * root,
            innovation.expand(self.systems, *innovation.shape),
            weight * own,
            # A full R has r = 0 where it stands in the columns: keep 0 / 0 away from others.
            torch.where(own > 0.0, noise, 1.0),
        )
        shift, deviations = local.shift[0], local.deviations[0]
        for i in range(1, self.systems):
            shift, deviations = merged_estimate(
                shift, deviations, local.shift[i], local.deviations[i]
            )
        moved = (observed @ shift.unsqueeze(-1)).squeeze(-1)
        return Conditioned(
            (rows @ shift.unsqueeze(-1)).squeeze(-1),
            product(rows, deviations),
            innovation - moved,
            product(observed, deviations),
        )
