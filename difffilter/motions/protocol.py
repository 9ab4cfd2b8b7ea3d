"""What a filter asks of a motion model, and defaults for what most models share."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from torch import Tensor

from difffilter.logs.states import AXES, KINDS, kinds_by_name
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants

__all__ = ["AXES", "KINDS", "Inputs", "Motion", "MotionBase", "kinds_by_name"]

Inputs = Mapping[str, Tensor]


class Motion(Protocol):
    """What a filter asks of a motion model.

    The mean has n numbers, the ``states``. Deviations live in the tangent space, of the same
    n numbers where ``flat``; otherwise (angles that wrap, unit quaternions) of the p numbers
    named by ``tangent``, which ``retract`` and ``local`` tie to the mean.
    """

    @property
    def linear(self) -> bool:
        """Whether the transition is linear in the state: then cubature needs no points."""

    @property
    def flat(self) -> bool:
        """Whether ``retract`` and ``local`` are plus and minus."""

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the n numbers of the mean."""

    @property
    def tangent(self) -> tuple[str, ...]:
        """Names of the p numbers of the tangent space: rows of the deviations."""

    @property
    def kinds(self) -> Mapping[str, str]:
        """What each state is: one of ``KINDS``, by name."""

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Declared parameters."""

    def prepare(self, values: Values) -> Constants:
        """Constants of a run, from the physical values."""

    def transition(self, mean: Tensor, dt: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        """f(m): (..., n) -> (..., n)."""

    def propagate(
        self, mean: Tensor, deviations: Tensor, dt: Tensor, inputs: Inputs, constants: Constants
    ) -> Tensor:
        """F X with F the Jacobian of local(f(m), f(retract(m, s))) at s = 0: (..., p, k)."""

    def noise(self, mean: Tensor, dt: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        """G L_Q, deviations of the process noise at the mean before the step: (..., p, q)."""

    def retract(self, mean: Tensor, shift: Tensor) -> Tensor:
        """The mean (..., n) moved by a shift of the tangent space (..., p)."""

    def local(self, a: Tensor, b: Tensor) -> Tensor:
        """The shift (..., p) that moves a to b, the inverse of ``retract``: (..., n) each."""


class _Named(Protocol):
    @property
    def states(self) -> tuple[str, ...]: ...


class MotionBase:
    """Defaults for a motion model: a flat state, its kinds by the names of the states."""

    @property
    def flat(self) -> bool:
        return True

    @property
    def tangent(self: _Named) -> tuple[str, ...]:
        return self.states

    @property
    def kinds(self: _Named) -> Mapping[str, str]:
        return kinds_by_name(self.states)

    def retract(self, mean: Tensor, shift: Tensor) -> Tensor:
        return mean + shift

    def local(self, a: Tensor, b: Tensor) -> Tensor:
        return b - a
