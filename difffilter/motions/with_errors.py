"""A motion with further states behind its own: errors of sensors that last."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from difffilter.core.linalg import join, positive_sqrt
from difffilter.motions.protocol import Inputs, Motion
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants

__all__ = ["WithErrors"]

SIGMA, TIME = "errors.sigma", "errors.time"


class Errors(Protocol):
    """Error states that share parameters: their names, and those of sigma and time."""

    @property
    def states(self) -> tuple[str, ...]:
        """Names."""

    @property
    def sigma(self) -> str:
        """Parameter of the standard deviation."""

    @property
    def time(self) -> str:
        """Parameter of the correlation time, s."""


@dataclass(frozen=True)
class WithErrors:
    """A motion whose state goes on with first-order Gauss-Markov processes.

    Over dt each is multiplied by a = exp(-dt / tau) and gets noise of standard deviation
    sigma sqrt(1 - a^2): stationary at sigma, exact for uneven times (Gelb, Applied Optimal
    Estimation, 1974, section 3.8).

    Attributes:
        motion: of the states before them, whatever its tangent space.
        errors: the states, and the names of their parameters, which a sensor declares.
    """

    motion: Motion
    errors: tuple[Errors, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the error states."""
        return tuple(name for part in self.errors for name in part.states)

    @property
    def linear(self) -> bool:
        return self.motion.linear

    @property
    def flat(self) -> bool:
        return self.motion.flat

    @property
    def states(self) -> tuple[str, ...]:
        return (*self.motion.states, *self.names)

    @property
    def tangent(self) -> tuple[str, ...]:
        return (*self.motion.tangent, *self.names)

    @property
    def kinds(self) -> Mapping[str, str]:
        return {**self.motion.kinds, **dict.fromkeys(self.names, "other")}

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return self.motion.parameters

    def prepare(self, values: Values) -> Constants:
        """The motion's, and sigma and time of each error state (e,)."""

        def of(field: str) -> Tensor:
            parts = [values[getattr(p, field)].expand(len(p.states)) for p in self.errors]
            return torch.cat(parts)

        return self.motion.prepare(values) | {SIGMA: of("sigma"), TIME: of("time")}

    def _kept(self, dt: Tensor, constants: Constants) -> Tensor:
        """(..., e), the factor of each error over dt."""
        return torch.exp(-dt.unsqueeze(-1) / constants[TIME])

    def transition(self, mean: Tensor, dt: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        n = len(self.motion.states)
        moved = self.motion.transition(mean[..., :n], dt, inputs, constants)
        errors = self._kept(dt, constants) * mean[..., n:]
        return torch.cat([moved, errors.expand(*moved.shape[:-1], -1)], dim=-1)

    def propagate(
        self, mean: Tensor, deviations: Tensor, dt: Tensor, inputs: Inputs, constants: Constants
    ) -> Tensor:
        n, p = len(self.motion.states), len(self.motion.tangent)
        own = deviations[..., :p, :]
        moved = self.motion.propagate(mean[..., :n], own, dt, inputs, constants)
        errors = self._kept(dt, constants).unsqueeze(-1) * deviations[..., p:, :]
        return join([moved, errors.expand(*moved.shape[:-2], -1, -1)], -2)

    def noise(self, mean: Tensor, dt: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        n = len(self.motion.states)
        own = self.motion.noise(mean[..., :n], dt, inputs, constants)
        grown = positive_sqrt(-torch.expm1(-2.0 * dt.unsqueeze(-1) / constants[TIME]))
        errors = torch.diag_embed(constants[SIGMA] * grown)
        lead = torch.broadcast_shapes(own.shape[:-2], errors.shape[:-2])  # type: ignore[no-untyped-call]
        above = torch.nn.functional.pad(own, (0, errors.shape[-1]))
        below = torch.nn.functional.pad(errors, (own.shape[-1], 0))
        return torch.cat([x.expand(*lead, *x.shape[-2:]) for x in (above, below)], dim=-2)

    def retract(self, mean: Tensor, shift: Tensor) -> Tensor:
        n, p = len(self.motion.states), len(self.motion.tangent)
        moved = self.motion.retract(mean[..., :n], shift[..., :p])
        return torch.cat([moved, mean[..., n:] + shift[..., p:]], dim=-1)

    def local(self, a: Tensor, b: Tensor) -> Tensor:
        n = len(self.motion.states)
        own = self.motion.local(a[..., :n], b[..., :n])
        return torch.cat([own, b[..., n:] - a[..., n:]], dim=-1)
