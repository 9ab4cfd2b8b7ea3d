"""A sensor that tells late: what it reads was true some time before its row."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from difffilter.core.jacobian import jacobian_times
from difffilter.parameters.constraints import Real
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants
from difffilter.sensors.sensor import Inputs, Noise
from difffilter.sensors.wrapped import Wrapped, named

__all__ = ["Delayed"]


@dataclass(frozen=True)
class Delayed(Wrapped):
    """A sensor that measures the state of ``NAME.delay`` seconds before the row's time.

    It predicts h(f(x, -d)): the motion moves the state back by the delay d, exactly where f is
    reversible (constant velocity: x - d v); the process noise within d is left out
    [reconstruction]. The motion must take negative times. A delay below 0 is a time stamp that
    is late. The innovation's slope towards d is the speed, so that logs of a moving target
    determine it.

    Attributes:
        sensor: with a name.
        delay: published, s.
        motion: set by the filter; without it there is no delay.

    Raises:
        InputError: a sensor without name.

    Example:
        >>> from difffilter import ConstantVelocity, Delayed, Filter, Position
        >>> fix = Delayed(Position(name="fix", sigma=2.0), delay=0.2)
        >>> Filter(ConstantVelocity(), (fix,), tuned=["fix.delay"]).declarations["fix.delay"].unit
        's'
    """

    delay: float = 0.0
    motion: Any = None

    def __post_init__(self) -> None:
        named(self.sensor, "delay")

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        own = Parameter(
            f"{self.name}.delay", float(self.delay), Real(0.1), "s",
            meaning="how much older a measurement is than its row",
        )  # fmt: skip
        return (*self.sensor.parameters, own)

    def prepare(self, values: Values) -> Constants:
        return self.sensor.prepare(values) | {f"{self.name}.delay": values[f"{self.name}.delay"]}

    def _back(self, state: Tensor, constants: Constants) -> Tensor:
        """Minus the delay, (...) as the state's leading dimensions."""
        return -constants[f"{self.name}.delay"].expand(state.shape[:-1])

    def predict(self, state: Tensor, inputs: Inputs, constants: Constants) -> Tensor:
        if self.motion is not None:
            back = self._back(state, constants)
            state = self.motion.transition(state, back, inputs, constants)
        return self.sensor.predict(state, inputs, constants)

    def observe(
        self, state: Tensor, deviations: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        if self.motion is None:
            return self.sensor.observe(state, deviations, inputs, constants)
        if not self.motion.flat:

            def h(x: Tensor) -> Tensor:
                return self.predict(x, inputs, constants)

            return h(state), jacobian_times(h, state, deviations)
        back = self._back(state, constants)
        then = self.motion.transition(state, back, inputs, constants)
        moved = self.motion.propagate(state, deviations, back, inputs, constants)
        return self.sensor.observe(then, moved, inputs, constants)

    def noise(self, mean: Tensor, inputs: Inputs, constants: Constants) -> Noise:
        return self.sensor.noise(mean, inputs, constants)
