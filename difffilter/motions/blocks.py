"""The motion models by name; what they share: :mod:`difffilter.motions.protocol`."""

from difffilter.motions.constant_velocity import NOISES, ConstantVelocity
from difffilter.motions.coordinated_turn import CoordinatedTurn
from difffilter.motions.function import FunctionMotion
from difffilter.motions.protocol import AXES, KINDS, Motion, MotionBase

__all__ = [
    "AXES",
    "KINDS",
    "NOISES",
    "ConstantVelocity",
    "CoordinatedTurn",
    "FunctionMotion",
    "Motion",
    "MotionBase",
]
