"""Filter on Chan's positions from smoothed range differences (paper 3, reference [8])."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import torch
from torch import Tensor

from difffilter.baselines.closed_form import chan, range_differences, the_tdoa
from difffilter.baselines.least_squares import Snapshot, check_channels
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.motions.blocks import ConstantVelocity
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Number, Parameter, Values, check_values
from difffilter.parameters.values import Constants
from difffilter.running.batch import run, start_belief
from difffilter.sensors.builtin import Position, PositionSensor
from difffilter.sensors.information import Information
from difffilter.sensors.sensor import Inputs, Noise
from difffilter.start.fit import Fix
from difffilter.start.measurements import from_measurements

__all__ = ["ChanEKF"]

WHITENING = "chan.whitening"
RANGE_ACCELERATION = "chan.range_acceleration"


@dataclass(frozen=True, kw_only=True)
class WhitenedPosition(PositionSensor):
    """A position of known, varying covariance C, divided by its factor: noise of unit variance.

    z = L^-1 p and h(x) = L^-1 [I 0] x with C = L L^T; L^-1 (..., axes, axes) is the log's
    input ``chan.whitening``.
    """

    name: str = "chan"

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        return ()

    def prepare(self, values: Values) -> Constants:
        like = next(iter(values.values()))
        unit, zero = like.new_ones(self.axes), like.new_zeros(self.axes)
        return Constants({"chan.unit": unit, "chan.bias": zero})

    def noise(self, mean: Tensor, inputs: Inputs, constants: Constants) -> Noise:
        unit = constants["chan.unit"]
        return Noise(unit, unit.new_zeros(self.axes, 0), unit)

    def measure(
        self, position: Tensor, inputs: Inputs, constants: Constants
    ) -> tuple[Tensor, Tensor]:
        whitening = inputs[WHITENING]
        return (whitening @ position.unsqueeze(-1)).squeeze(-1), whitening


@dataclass(frozen=True)
class ChanEKF(Snapshot):
    """Each range difference smoothed by a Kalman filter of its own, then Chan, then a filter.

    The smoother is :class:`Filter` with constant velocity of each range difference; its
    start is h(m0) and H v0 with the variances of H P0 H^T. Chan's closed form takes the
    smoothed values of the channels present at the row and their covariance; the last filter
    takes Chan's position with Chan's covariance. The smoothed values' errors are correlated
    in time; as in the paper, that is ignored. A row without a fix is prediction alone.

    Attributes:
        sensors: one TDOA sensor, its stations without heights.
        motion: of the aircraft.
        range_acceleration: process noise of the range differences, m/s^2 (parameter
            ``chan.range_acceleration``); twice the aircraft's bounds it, since
            |d(r_i - r_1) / d position| <= 2 [reconstruction].
        start_sigma: as for :class:`Filter`.
        iterations, tangent: as in :func:`chan`.
    """

    motion: ConstantVelocity = field(default_factory=ConstantVelocity)
    range_acceleration: float = 2 * 5.77
    start_sigma: Number | None = None
    iterations: int = 2
    tangent: bool = False

    def __post_init__(self) -> None:
        the_tdoa(self.sensors, self.axes)
        if self.motion.axes != self.axes:
            raise InputError(f"motion axes: found {self.motion.axes}, expected {self.axes}")

    @property
    def states(self) -> tuple[str, ...]:
        return self.motion.states

    @property
    def _own_parameters(self) -> tuple[Parameter, ...]:
        acceleration = Parameter(
            RANGE_ACCELERATION,
            self.range_acceleration,
            Positive(),
            "m/s^2",
            meaning="process noise of a range difference: standard deviation",
        )
        return (*self.position_filter.declarations.values(), *super()._own_parameters, acceleration)

    @cached_property
    def position_filter(self) -> Filter:
        """Filter on the whitened positions."""
        sensor = WhitenedPosition(axes=self.axes)
        return Filter(self.motion, (sensor,), start_sigma=self.start_sigma)

    def estimate(
        self,
        log: Log,
        values: Values | None = None,
        start: Start | None = None,
        progress: bool = False,
    ) -> Track:
        """Track over the log; ``start``, else the log's, else from the measurements.

        Raises:
            InputError: other channels, a value that does not fit, no covariance at the start.
            NonFiniteError: an estimate that is not finite.
        """
        check_channels(log, self.channels)
        values = check_values(self.declarations, self.published(log.z.dtype) | dict(values or {}))
        constants = self.prepare(values)
        own = {name: values[name] for name in self.position_filter.declarations}
        start = start or log.start or from_measurements(self, log, values)
        smoothed = self.smooth(log, constants, start, progress)
        fix = self.positions(log, constants, smoothed)
        known = torch.isfinite(fix.position).unsqueeze(-1)
        unit = torch.eye(self.axes, dtype=log.z.dtype, device=log.z.device)
        factor = torch.where(known, fix.deviations, unit)
        whitening = torch.linalg.solve_triangular(factor, unit.expand_as(factor), upper=True)
        z = (whitening @ fix.position.unsqueeze(-1)).squeeze(-1)
        channels = self.position_filter.channels
        white = Log(channels, log.time, z, inputs={WHITENING: whitening}, names=log.names)
        track = run(self.position_filter, white, own, start, progress=progress)
        return Track(self.states, self.channels, log.time, track.mean, track.deviations)

    def smooth(self, log: Log, constants: Constants, start: Start, progress: bool) -> Track:
        """Range differences and their rates (T, ..., 2 m), by a filter of each channel."""
        sensor = the_tdoa(self.sensors, self.axes)
        origin = torch.zeros(self.axes, dtype=log.z.dtype)  # its noise depends on no state
        m, noise = len(self.channels), sensor.noise(origin, log.inputs, constants)
        full = bool(noise.common.shape[-1])
        sigma = noise.total.sqrt()
        if full:
            sigma = torch.diag(noise.independent) + noise.common @ noise.common.mT
        difference = Position(
            name="difference",
            channels=self.channels,
            axes=m,
            sigma=tuple(map(tuple, torch.eye(m).tolist())) if full else (1.0,) * m,
        )
        smoother = Filter(ConstantVelocity(m, names=self.channels), (difference,))
        z, _ = range_differences(sensor, log, constants)
        first = {name: value[0] for name, value in log.inputs.items()}
        here = start_belief(self.position_filter, constants, start)
        h, gradient = sensor.measure(here.mean[..., : self.axes], first, constants)
        rate = (gradient @ here.mean[..., self.axes :].unsqueeze(-1)).squeeze(-1)
        position, velocity = here.deviations.tensor_split(2, dim=-2)
        spread = [(gradient @ part).square().sum(-1) for part in (position, velocity)]
        return run(
            smoother,
            Log(self.channels, log.time, z, names=log.names),
            {"motion.acceleration": constants[RANGE_ACCELERATION], "difference.sigma": sigma},
            Start(
                torch.cat([h, rate], dim=-1),
                torch.diag_embed(torch.cat(spread, dim=-1)),
                start.time,
            ),
            progress=progress,
        )

    def positions(self, log: Log, constants: Constants, smoothed: Track) -> Fix:
        """Chan's position of each row from the smoothed range differences."""
        sensor, m = the_tdoa(self.sensors, self.axes), len(self.channels)
        _, stations = range_differences(sensor, log, constants)
        # A start without variance has a singular covariance at its own time: keep it regular.
        noise = sensor.noise(smoothed.mean[..., : self.axes], log.inputs, constants)
        floor = torch.finfo(log.z.dtype).eps * noise.total
        spread = smoothed.deviations[..., :m, :]
        information = Information(floor.expand_as(log.z), spread, log.present).matrix
        z = torch.where(log.present, smoothed.mean[..., :m], torch.nan)
        return chan(z, stations, information, self.iterations, self.tangent)
