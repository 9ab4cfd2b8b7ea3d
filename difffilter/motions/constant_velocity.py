"""Constant velocity, driven by a random acceleration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from difffilter.core.linalg import semidefinite_cholesky
from difffilter.errors import InputError
from difffilter.motions.protocol import AXES, Inputs, MotionBase
from difffilter.parameters.constraints import Covariance, Positive
from difffilter.parameters.parameters import Number, Parameter, Values, as_number
from difffilter.parameters.values import Constants

__all__ = ["NOISES", "ConstantVelocity"]

NOISES = ("discrete", "continuous", "state")


@dataclass(frozen=True)
class ConstantVelocity(MotionBase):
    """Constant velocity driven by a random acceleration, in 1 to 3 axes (or more).

    States are the positions, then the velocities. Per axis, with acceleration noise q:

    * ``discrete``: the acceleration is constant within a step, G = [dt^2/2, dt] (paper 3,
      eq. 8; paper 1): deviations G q, q in m/s^2;
    * ``continuous``: white acceleration of density q^2, q in m/s^1.5 (paper 2):
      Q = q^2 [[dt^3/3, dt^2/2], [dt^2/2, dt]];
    * ``state``: independent noise on every state, at each step whatever dt is (paper 4):
      deviations diag(``motion.state_sigma``), one number or one per state.

    The parameter ``motion.acceleration`` is a scale (one number), a diagonal (one per
    axis) or a full covariance of the acceleration (axes x axes).
    """

    linear: ClassVar[bool] = True

    axes: int = 2
    noise_kind: str = "discrete"
    acceleration: Number = 1.0
    names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.noise_kind not in NOISES:
            expected = " or ".join(NOISES)
            raise InputError(f"motion noise: found {self.noise_kind!r}, expected {expected}")
        if self.axes < 1 or (self.axes > len(AXES) and len(self.names) != self.axes):
            raise InputError(f"motion axes: found {self.axes}, expected 1 to {len(AXES)}")

    @property
    def states(self) -> tuple[str, ...]:
        names = self.names or AXES[: self.axes]
        return (*names, *(f"v{name}" for name in names))

    @property
    def kinds(self) -> dict[str, str]:
        kinds = ("position",) * self.axes + ("velocity",) * self.axes
        return dict(zip(self.states, kinds, strict=True))

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        value = as_number(self.acceleration)
        if self.noise_kind == "state":
            return (self._state_sigma(value),)
        shape = torch.tensor(value).shape
        if shape not in ((), (self.axes,), (self.axes, self.axes)):
            raise InputError(
                f"motion.acceleration: found shape {list(shape)}, expected one number, "
                f"{self.axes} numbers or a {self.axes} x {self.axes} covariance"
            )
        unit = "m/s^2" if self.noise_kind == "discrete" else "m/s^1.5"
        full = len(shape) == 2
        return (
            Parameter(
                "motion.acceleration",
                value,
                Covariance() if full else Positive(),
                f"({unit})^2" if full else unit,
                labels=(self.names or AXES[: self.axes]) if len(shape) == 1 else (),
                meaning="process noise: covariance"
                if full
                else "process noise: standard deviation",
                noise=True,
            ),
        )

    def _state_sigma(self, value: Number) -> Parameter:
        shape = torch.tensor(value).shape
        if shape not in ((), (2 * self.axes,)):
            raise InputError(
                f"motion.state_sigma: found shape {list(shape)}, expected one number or "
                f"{2 * self.axes} numbers"
            )
        return Parameter(
            "motion.state_sigma",
            value,
            Positive(),
            "m, m/s",
            labels=self.states if shape else (),
            meaning="process noise of the states: standard deviation per step",
            noise=True,
        )

    def prepare(self, values: Values) -> Constants:
        if self.noise_kind == "state":
            sigma = values["motion.state_sigma"].expand(2 * self.axes)
            return Constants({"motion.factor": torch.diag_embed(sigma)})
        value = values["motion.acceleration"]
        if value.dim() == 2:
            factor = semidefinite_cholesky(value)
        else:
            factor = torch.diag_embed(value.expand(self.axes))
        return Constants({"motion.factor": factor})

    def transition(self, mean: Tensor, dt: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        return self.move(mean.movedim(-1, 0), dt, inputs, constants).movedim(0, -1)

    def propagate(
        self, mean: Tensor, deviations: Tensor, dt: Tensor, inputs: Inputs, constants: Constants
    ) -> Tensor:
        rows = deviations.movedim((-2, -1), (0, 1))
        return self.move(rows, dt, inputs, constants).movedim((0, 1), (-2, -1))

    def move(self, rows: Tensor, dt: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        """F times anything with the states first and the trajectories last."""
        position, velocity = rows[: self.axes], rows[self.axes :]
        return torch.cat([position + dt * velocity, velocity])

    def noise(self, mean: Tensor, dt: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        factor, step = Constants.of(constants)["motion.factor"], dt[..., None, None]
        if self.noise_kind == "state":
            return factor.expand(*dt.shape, *factor.shape)
        if self.noise_kind == "discrete":
            return torch.cat([0.5 * step.square() * factor, step * factor], dim=-2)
        # Cholesky factor of the continuous Q: [[dt^1.5/sqrt 3, 0], [sqrt(3 dt)/2, sqrt(dt)/2]]
        root = step.sqrt() * factor
        position = torch.cat([step * root / 3**0.5, torch.zeros_like(root)], dim=-1)
        velocity = torch.cat([3**0.5 / 2 * root, 0.5 * root], dim=-1)
        return torch.cat([position, velocity], dim=-2)
