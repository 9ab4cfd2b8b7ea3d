"""Estimators without memory: each row of a log by itself. Taylor-series least squares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from torch import Tensor

from difffilter.errors import InputError
from difffilter.filters.declared import Composed, Part
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.motions.blocks import AXES
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants
from difffilter.sensors.sensor import Sensor
from difffilter.start.fit import Fix, gauss_newton
from difffilter.start.measurements import from_measurements
from difffilter.weights.registry import Weight, plain

__all__ = ["Snapshot", "TaylorLeastSquares", "gauss_newton"]


@dataclass(frozen=True)
class Snapshot(Composed):
    """What estimators of the position alone share: declarations, and the track of a log.

    Attributes:
        sensors: the measurement models; channels are theirs, in order.
        axes: components of the position, the estimator's states.
        overrides: declarations that replace the sensors' own, by name.
    """

    sensors: tuple[Sensor, ...]
    axes: int = 2
    overrides: Mapping[str, Parameter] = field(default_factory=dict)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the position's components."""
        return AXES[: self.axes]

    def estimate(
        self,
        log: Log,
        values: Values | None = None,
        start: Start | None = None,
        progress: bool = False,
    ) -> Track:
        """Every row by itself: states ``x, y``, deviations from the fit's covariance.

        Mean and deviations are NaN at a row whose channels do not determine a position.

        Args:
            log: z (T, m) or (T, ..., m); channels as the estimator's.
            values: physical parameter values, differentiable; the declared ones if missing.
            start: where each row's iteration starts, if the method iterates.
            progress: without effect: all rows are computed at once.

        Raises:
            InputError: other channels, a value that does not fit.
        """
        check_channels(log, self.channels)
        constants = self.prepare(self.published(log.z.dtype) | dict(values or {}))
        fix = self.fix(log, constants, values, start)
        return Track(self.states, self.channels, log.time, fix.position, fix.deviations)

    def fix(
        self, log: Log, constants: Constants, values: Values | None, start: Start | None
    ) -> Fix:
        """Position of every row."""
        raise NotImplementedError(type(self).__name__)


@dataclass(frozen=True)
class TaylorLeastSquares(Snapshot):
    """Taylor-series least squares per row (paper 3, baseline), by :func:`gauss_newton`.

    Attributes:
        sensors: position, range, TDOA or the user's own, any mix.
        weight: weight function of residuals in sigmas; ``plain`` for least squares.
        iterations: steps per row.

    Each row starts at the position of ``start``, else of the log's start, else of
    :func:`difffilter.start.measurements.from_measurements`
    (an error if no row determines a position).

    Example:
        >>> import torch
        >>> from difffilter.logs.log import Log
        >>> from difffilter.sensors.builtin import Range
        >>> ranges = Range(stations=[(0, 0), (10, 0), (0, 10)], channels=("a", "b", "c"))
        >>> log = Log(("a", "b", "c"), torch.zeros(1), torch.tensor([[5.0, 8.062, 6.708]]))
        >>> TaylorLeastSquares((ranges,)).estimate(log).mean.round(decimals=2)
        tensor([[3., 4.]])
    """

    weight: Weight = plain
    iterations: int = 10

    @property
    def parts(self) -> Sequence[Part]:
        return (*self.sensors, self.weight)

    def fix(
        self, log: Log, constants: Constants, values: Values | None, start: Start | None
    ) -> Fix:
        start = start or log.start or from_measurements(self, log, values)

        def weigh(s: Tensor) -> Tensor:
            return self.weight(s, constants)

        return gauss_newton(
            sensors=self.sensors,
            constants=constants,
            z=log.z,
            inputs=log.inputs,
            start=start.mean[..., : self.axes],
            weigh=None if self.weight is plain else weigh,
            iterations=self.iterations,
        )


def check_channels(log: Log, channels: tuple[str, ...]) -> None:
    """InputError unless the log has just these channels, in this order."""
    if log.channels != channels:
        raise InputError(
            f"log: found channels {', '.join(log.channels)}, expected {', '.join(channels)}"
        )
