"""A turn at a known rate."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.motions.constant_velocity import ConstantVelocity
from difffilter.motions.protocol import Inputs
from difffilter.parameters.constraints import Real
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants

__all__ = ["CoordinatedTurn"]


@dataclass(frozen=True)
class CoordinatedTurn(ConstantVelocity):
    """Turn at a known rate w, rad/s, from x towards y; noise as :class:`ConstantVelocity`.

    F = [[1, 0, sin(wT)/w, -(1 - cos wT)/w], [0, 1, (1 - cos wT)/w, sin(wT)/w],
    [0, 0, cos wT, -sin wT], [0, 0, sin wT, cos wT]] (paper 4's F_CT, states x, y, vx, vy),
    straight ahead at w = 0. The rate is the parameter ``motion.turn_rate``, or a known input
    ``turn_rate`` of the log. ``reverse`` turns to the other side at the same rate, so that two
    modes of a :class:`difffilter.Mixture` share one number.
    """

    turn_rate: float = 0.0
    reverse: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.axes != 2:
            raise InputError(f"motion axes: found {self.axes}, expected 2 for a coordinated turn")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        rate = Parameter(
            "motion.turn_rate", self.turn_rate, Real(0.01), "rad/s", meaning="turn rate"
        )
        return (*super().parameters, rate)

    def prepare(self, values: Values) -> Constants:
        return super().prepare(values) | {"motion.turn_rate": values["motion.turn_rate"]}

    def move(self, rows: Tensor, dt: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        rate = inputs.get("turn_rate", Constants.of(constants)["motion.turn_rate"])
        rate = -rate if self.reverse else rate
        angle = rate * dt
        # sin(a)/a and (1 - cos a)/a, their values and gradients also at a = 0.
        along = torch.sinc(angle / torch.pi) * dt
        across = 0.5 * angle * torch.sinc(0.5 * angle / torch.pi).square() * dt
        x, y, vx, vy = rows
        return torch.stack(
            [
                x + along * vx - across * vy,
                y + across * vx + along * vy,
                angle.cos() * vx - angle.sin() * vy,
                angle.sin() * vx + angle.cos() * vy,
            ]
        )
