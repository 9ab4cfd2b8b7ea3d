"""Motion models by name: what scenario files call them, and what makes each."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, TypeVar

from difffilter.errors import InputError
from difffilter.motions.blocks import ConstantVelocity, CoordinatedTurn, Motion
from difffilter.parameters.parameters import Number
from difffilter.registry import Registry

__all__ = ["MOTIONS", "motion"]

Factory = TypeVar("Factory", bound=Callable[..., Motion])
#: The same as ``NOISES``, for type checkers.
NoiseKind = Literal["discrete", "continuous", "state"]

#: Class or function that makes each motion model. Its keyword arguments are the keys of
#: ``[motion]`` and fields of ``[parameters.motion]``, see :func:`motion`.
MOTIONS: Registry[Callable[..., Motion]] = Registry("motion")


def motion(name: str) -> Callable[[Factory], Factory]:
    """Decorator: enters a class or function that makes a motion model in :data:`MOTIONS`.

    It is called with ``axes`` of the scenario, if it takes that keyword, and with its own. An own
    keyword is a key of ``[motion]`` by its type, as for :func:`difffilter.sensor`. The value of
    ``[parameters.motion.FIELD]`` is the keyword FIELD. States x, y, z are the position, and
    vx, vy, vz the velocity.

    Raises:
        InputError: the name is taken, or is no name.
    """

    def enter(factory: Factory) -> Factory:
        MOTIONS.add(name, factory)
        return factory

    return enter


def _level(noise: str, acceleration: Number | None, state_sigma: Number | None) -> Number:
    """The published level of a kind of noise; InputError where none is published."""
    level = state_sigma if noise == "state" else acceleration
    if level is None:
        field = "state_sigma" if noise == "state" else "acceleration"
        raise InputError(f"needs [parameters.motion.{field}], found none")
    return level


@motion("constant-velocity")
def _constant_velocity(
    *,
    axes: int,
    noise: NoiseKind = "discrete",
    acceleration: Number | None = None,
    state_sigma: Number | None = None,
) -> ConstantVelocity:
    return ConstantVelocity(axes, noise, _level(noise, acceleration, state_sigma))


@motion("coordinated-turn")
def _coordinated_turn(
    *,
    axes: int,
    noise: NoiseKind = "discrete",
    acceleration: Number | None = None,
    state_sigma: Number | None = None,
    reverse: bool = False,
) -> CoordinatedTurn:
    level = _level(noise, acceleration, state_sigma)
    return CoordinatedTurn(axes, noise, level, reverse=reverse)
