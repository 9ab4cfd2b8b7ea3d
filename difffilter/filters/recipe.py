"""What every estimator declares, and what every recursive one does besides."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import InitVar, dataclass, field
from typing import TYPE_CHECKING, Self

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.errors import InputError
from difffilter.filters.declared import Composed, Declared, Part
from difffilter.filters.placing import own_motion, placed, unplaced
from difffilter.logs.track import Track
from difffilter.motions.protocol import Motion
from difffilter.parameters.constraints import Positive
from difffilter.parameters.parameters import Number, Parameter, Values, as_number
from difffilter.parameters.selection import tuned_alone
from difffilter.parameters.values import Constants
from difffilter.sensors.information import common_noise
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.wrapped import check_inputs, inputs_of

__all__ = ["RULES", "Modelled", "Recipe", "check_independent", "declared_start", "motion_of"]

RULES = ("taylor", "cubature")


class Recipe(Declared):
    """A recursive estimator: constants from values, a first belief, and a pure step.

    :func:`difffilter.run`, the tracker, tuning and the engine work on any recipe.
    """

    if TYPE_CHECKING:  # fields of most recipes, properties of others

        @property
        def motion(self) -> Motion:
            """The motion model: what starts and golden walks are made of."""

        @property
        def sensors(self) -> tuple[Sensor, ...]:
            """The measurement models: what starts and names are made of."""

        @property
        def overrides(self) -> Mapping[str, Parameter]:
            """Declarations that replace the components' own, by name."""

        @property
        def iterations(self) -> int:
            """How often a step conditions beyond once."""

    @property
    def foretold(self) -> tuple[str, ...]:
        """Inputs that only a simulation knows; none of a filter that can be deployed."""
        return ()

    @property
    def inputs(self) -> tuple[str, ...]:
        """Columns of a log that its sensors read: positions of platforms, what noise follows."""
        return inputs_of(self.sensors)

    @property
    def bare_motion(self) -> Motion:
        """The motion without the states of errors that last."""
        return own_motion(self.motion)

    @property
    def bare_states(self) -> tuple[str, ...]:
        return self.states if motion_of(self) is None else self.bare_motion.states

    @property
    def bare_sensors(self) -> tuple[Sensor, ...]:
        return tuple(unplaced(sensor) for sensor in self.sensors)

    @property
    def mode_names(self) -> tuple[str, ...]:
        """Of a mixture; none for all else."""
        return ()

    def track(
        self,
        time: Tensor,
        mean: Tensor,
        deviations: Tensor,
        record: Record | None = None,
        final: Belief | None = None,
    ) -> Track:
        """Estimates of this recipe over time, with the names that they need."""
        motion = motion_of(self)
        return Track(
            states=self.states,
            channels=self.channels,
            time=time,
            mean=mean,
            deviations=deviations,
            record=record,
            final=final,
            modes=self.mode_names,
            kinds=self.kinds,
            error_states=self.error_states,
            local=None if motion is None or motion.flat else motion.local,
        )

    @property
    def centralised(self) -> Recipe:
        """The same without local filters: the same estimates while nothing is isolated."""
        return self

    @abstractmethod
    def with_values(self, values: Values) -> Self:
        """The same recipe with other declared values; InputError if one does not fit."""

    @abstractmethod
    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        """Raise InputError if a known input is missing: a platform, or what is foretold."""

    @abstractmethod
    def start(self, mean: Tensor, deviations: Tensor) -> Belief:
        """Initial belief from a mean (..., n) and deviations (..., n, n), memory at its start."""

    @abstractmethod
    def step(
        self, constants: Constants, belief: Belief, measurement: Measurement
    ) -> tuple[Belief, Record]:
        """One row: the belief after it, and the record of what was done.

        Pure and of static shape, like :func:`difffilter.step`, which says more.
        """


def motion_of(recipe: Recipe) -> Motion | None:
    """The recipe's motion; None for one that follows its measurements without a model."""
    motion: Motion | None = getattr(recipe, "motion", None)
    return motion


@dataclass(frozen=True)
class Modelled(Composed, Recipe):
    """A recipe of one motion and its sensors; base of :class:`Filter` and :class:`Fusion`.

    Attributes:
        motion, sensors: the models; channels are those of the sensors, in order.
        linearise: ``taylor`` (first order, EKF) or ``cubature`` (SRCKF, see
            :mod:`difffilter.core.cubature`), of motion and sensors.
        start_sigma: initial standard deviation of each state (parameter ``start.sigma``),
            used where a run's start has no covariance; None for no such parameter. A state
            given as 0 is known exactly: it stays 0 in tuning too. Errors of sensors that last
            have their own sigma.
        overrides: declarations that replace the components' own (published value, source,
            tuned or not), by name.
        tuned: names or patterns (``range.*``) of the parameters that are tuned, and no others;
            None for what the declarations say.

    Raises:
        InputError: an unknown rule, a channel name twice, an override of no parameter, a
            pattern of no parameter.
    """

    motion: Motion
    sensors: tuple[Sensor, ...]
    linearise: str = field(default="taylor", kw_only=True)
    start_sigma: Number | None = field(default=None, kw_only=True)
    overrides: Mapping[str, Parameter] = field(default_factory=dict, kw_only=True)
    tuned: InitVar[Sequence[str] | None] = field(default=None, kw_only=True)

    def __post_init__(self, tuned: Sequence[str] | None) -> None:
        self._place()
        if self.linearise not in RULES:
            raise InputError(f"linearise: found {self.linearise!r}, expected {' or '.join(RULES)}")
        names = self.channels
        if len(set(names)) != len(names):
            raise InputError(f"channels: found a name twice in {', '.join(names)}")
        declared = self.declarations  # checked when it is made
        if tuned is not None:
            object.__setattr__(self, "overrides", tuned_alone(declared, tuned))
            del self.__dict__["declarations"]

    def _place(self) -> None:
        """Give errors that last their states, and delays their motion."""
        motion, sensors = placed(self.motion, self.sensors)
        object.__setattr__(self, "motion", motion)
        object.__setattr__(self, "sensors", sensors)

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the n states, the position first."""
        return self.motion.states

    @property
    def error_states(self) -> tuple[str, ...]:
        """Names of the rows of the deviations."""
        return self.motion.tangent

    @property
    def kinds(self) -> Mapping[str, str]:
        """What each state is, as the motion says."""
        return self.motion.kinds

    @property
    def parts(self) -> Sequence[Part]:
        """The motion and the sensors."""
        return (self.motion, *self.sensors)

    @property
    def _more_parameters(self) -> tuple[Parameter, ...]:
        """Those that are neither the motion's, nor the sensors', nor the start's."""
        return ()

    @property
    def _own_parameters(self) -> tuple[Parameter, ...]:
        own = (*super()._own_parameters, *self._more_parameters)
        if self.start_sigma is None:
            return own
        return (*own, declared_start(self.start_sigma, self.bare_motion.tangent))

    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        """Raise InputError if a known input of a sensor is missing: a platform, a column."""
        for sensor in self.sensors:
            check_inputs(sensor, inputs)


def check_independent(sensors: tuple[Sensor, ...], who: str) -> None:
    """InputError unless every sensor's noise is independent between channels."""
    for sensor in sensors:
        if common_noise(sensor):
            raise InputError(
                f"{who}: found noise common to channels of {sensor.channels[0]}, "
                "expected independent noise"
            )


def declared_start(start_sigma: Number, states: tuple[str, ...]) -> Parameter:
    """Declaration of ``start.sigma``, one number or one per row of the deviations."""
    sigma = as_number(start_sigma)
    shape = torch.tensor(sigma).shape
    if shape not in ((), (len(states),)):
        raise InputError(
            f"start.sigma: found shape {list(shape)}, expected one number or {len(states)} numbers"
        )
    known = sigma if isinstance(sigma, tuple) else ()
    return Parameter(
        "start.sigma",
        sigma,
        Positive(tuple(i for i, entry in enumerate(known) if entry == 0.0)),
        "m, m/s",
        labels=states if isinstance(sigma, tuple) else (),
        meaning="initial standard deviation",
    )
