"""Baselines by name: what scenario files call them, and how each is made."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from difffilter.baselines.bearing_lines import BearingLeastSquares
from difffilter.baselines.chan_ekf import ChanEKF
from difffilter.baselines.closed_form import ChanLeastSquares
from difffilter.baselines.least_squares import Snapshot, TaylorLeastSquares
from difffilter.errors import InputError
from difffilter.motions.blocks import ConstantVelocity, Motion
from difffilter.parameters.parameters import Number
from difffilter.registry import Registry
from difffilter.sensors.builtin import PositionSensor

__all__ = ["BASELINES", "Given", "baseline"]


@dataclass(frozen=True)
class Given:
    """What a baseline is made of.

    Attributes:
        sensors: with the published noise.
        axes: components of the position.
        moving: makes the published motion; InputError where none is published.
        start_sigma: as for :class:`Filter`, or None.
        known_velocity: m/s, of the target, where the start knows it.
    """

    sensors: tuple[PositionSensor, ...]
    axes: int
    moving: Callable[[], Motion]
    start_sigma: Number | None
    known_velocity: tuple[float, ...] | None

    @property
    def motion(self) -> Motion:
        """The published motion; InputError where none is published."""
        return self.moving()

    @property
    def velocity(self) -> tuple[float, ...]:
        """m/s, of the target; InputError where the start does not know it."""
        if self.known_velocity is None:
            raise InputError("estimator: found no velocity in [start], expected the target's")
        return self.known_velocity


#: How each baseline is made, by the name that scenario files know it by.
BASELINES: Registry[Callable[[Given], Snapshot]] = Registry("baseline")


def baseline(
    name: str,
) -> Callable[[Callable[[Given], Snapshot]], Callable[[Given], Snapshot]]:
    """Decorator: enters a function that makes a baseline from :class:`Given`.

    Raises:
        InputError: the name is taken, or is no name.
    """
    return BASELINES.register(name)


@baseline("taylor-ls")
def _taylor(given: Given) -> TaylorLeastSquares:
    return TaylorLeastSquares(given.sensors, given.axes)


@baseline("chan-ls")
def _chan(given: Given) -> ChanLeastSquares:
    return ChanLeastSquares(given.sensors, given.axes)


@baseline("chan-ekf")
def _chan_ekf(given: Given) -> ChanEKF:
    motion = given.motion
    if not isinstance(motion, ConstantVelocity):
        raise InputError("estimator: expected a motion of constant velocity with 'chan-ekf'")
    return ChanEKF(given.sensors, given.axes, motion=motion, start_sigma=given.start_sigma)


@baseline("bearing-ls")
def _pseudo_linear(given: Given) -> BearingLeastSquares:
    return BearingLeastSquares(given.sensors, given.axes, velocity=given.velocity)


@baseline("bearing-wls")
def _weighted(given: Given) -> BearingLeastSquares:
    return BearingLeastSquares(given.sensors, given.axes, velocity=given.velocity, weighted=True)
