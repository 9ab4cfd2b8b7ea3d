"""A filter as a pure function of one step: predict, linearise, weigh, condition."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

from torch import Tensor

from difffilter.adaptation.protocol import Adaptation
from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.core.compression import compress
from difffilter.core.linearised import Linearised
from difffilter.errors import InputError
from difffilter.filters.prediction import Predicted, linearise, predict
from difffilter.filters.recipe import RULES, Modelled, check_independent
from difffilter.motions.retraction import moved
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants
from difffilter.robust.federation import Federation
from difffilter.robust.gate import Gate
from difffilter.robust.groups import Scope, channel_groups
from difffilter.robust.isolation import isolated
from difffilter.robust.recovery import STREAK, Recovery
from difffilter.robust.weighing import STANDARDISATIONS, Weighing
from difffilter.weights.registry import Weight, plain

__all__ = ["RULES", "STANDARDISATIONS", "Filter", "Prior"]


class Prior(NamedTuple):
    """What a row is conditioned on.

    Attributes:
        linear: the prediction and the measurement, before any weighing.
        present: (..., m), which channels are there.
        memory: of the adaptation so far.
        widening: (..., m) on gate and weights, of recovery; None without.
        left_out: (..., m), channels isolated as not finite; None where nothing is isolated.
    """

    linear: Linearised
    present: Tensor
    memory: Mapping[str, Tensor]
    widening: Tensor | None
    left_out: Tensor | None


@dataclass(frozen=True)
class Filter(Modelled):
    """One recursive filter: the recipe. Values of its parameters come from outside.

    Attributes:
        motion, sensors: the models; channels are those of the sensors, in order.
        linearise: ``taylor`` (first order, EKF) or ``cubature`` (SRCKF, see
            :mod:`difffilter.core.cubature`), of motion and sensors.
        weight: weight function of the measurement rows.
        standardise: residuals divided by the ``innovation``'s or the ``noise``'s sigma;
            None for ``noise`` in the M-EKF and ``innovation`` otherwise.
        iterations: 0 weighs the innovation once; n > 0 is the M-EKF (paper 3, eqs. 15-27):
            start at weight 1, then n reweightings from the residuals of the current
            estimate (the paper whitens them by the noise), the prior fixed throughout.
        weigh_prior: whether the M-EKF weighs the prediction's residuals too.
        mad: whether the M-EKF divides residuals by 1.48 times their median absolute
            deviation (over measurement rows, and prior rows if weighed).
        scope: which channels share one weight and one gate: each ``channel`` by itself, those
            of a ``sensor``, ``all``, or groups of channel names by group name (a channel
            that no group names is by itself).
        distance: how far a group is off: the ``rms`` of its standardised residuals, or their
            ``mahalanobis`` distance sqrt(e^T C^-1 e), C being S or R as ``standardise`` says
            (not divided by the number of channels, as in WoLF).
        gate: chi-square gate on each group's nominal NIS, or None.
        recovery: from lock-out by gate or weights, or None.
        federated: local filters, one for each sensor, fused and reset at every step
            (see :mod:`difffilter.robust.federation`); the same estimates.
        shares: information shares of the local filters; equal if empty.
        isolate: whether a sensor with anything that is not finite is left out of the row
            (see :mod:`difffilter.robust.isolation`); None for: where ``federated``.
        adaptation: plug-in between predict and condition, or None.
        clairvoyant: told of every fault: the log's inputs ``fault.mean`` and
            ``fault.variance`` (..., m) are taken off the measurement and added to R; an
            infinite variance deletes the channel. A bound, not a filter to deploy.
        start_sigma: initial standard deviation of each state (parameter ``start.sigma``),
            used where a run's start has no covariance; None for no such parameter. A state
            given as 0 is known exactly: it stays 0 in tuning too. Errors of sensors that last
            have their own sigma.
        overrides: declarations that replace the components' own (published value, source,
            tuned or not), by name.
        tuned: names or patterns (``range.*``) of the parameters that are tuned, and no others;
            None for what the declarations say.

    Raises:
        InputError: options that are unknown or do not fit together, a channel name twice, an
            override of no parameter.

    Example:
        >>> from difffilter import TDOA, ConstantVelocity, Filter, tanh
        >>> stations = [(0, 0), (1600, 0), (0, 3500), (1600, 3500)]
        >>> robust = Filter(ConstantVelocity(2), (TDOA(stations=stations, sigma=3.0),), tanh,
        ...                 iterations=5)
        >>> sorted(robust.declarations)
        ['motion.acceleration', 'tanh.ab', 'tdoa.bias', 'tdoa.sigma']
    """

    weight: Weight = plain
    standardise: str | None = None
    iterations: int = 0
    weigh_prior: bool = False
    mad: bool = False
    scope: Scope = "channel"
    distance: str = "rms"
    gate: Gate | None = None
    recovery: Recovery | None = None
    federated: bool = False
    shares: tuple[float, ...] = ()
    adaptation: Adaptation | None = None
    clairvoyant: bool = False
    isolate: bool | None = None

    def __post_init__(self, tuned: Sequence[str] | None) -> None:
        self._place()
        if self.standardise is None:
            default = "noise" if self.iterations else "innovation"
            object.__setattr__(self, "standardise", default)
        if self.shares and not self.federated:
            raise InputError("shares: expected federated with them")
        _ = self.weighing  # checked when the filter is made
        inflating = self.recovery is not None and self.recovery.action == "inflate"
        if inflating and self.standardise == "noise" and not self.iterations:
            # A larger P moves no weight then: it would grow for ever.
            raise InputError("recovery inflate: expected standardise innovation, or iterations")
        if getattr(self.adaptation, "independent_noise", False):
            check_independent(self.sensors, "adaptation")
        super().__post_init__(tuned)

    @cached_property
    def weighing(self) -> Weighing:
        """What weights the channels get, and how the belief is conditioned with them."""
        return Weighing(
            weight=self.weight,
            standardise=self.standardise or "innovation",
            iterations=self.iterations,
            weigh_prior=self.weigh_prior,
            mad=self.mad,
            groups=self.grouped,
            distance=self.distance,
            gate=self.gate,
            federation=self.federation,
        )

    @cached_property
    def federation(self) -> Federation | None:
        """The local filters, one for each sensor; None if not ``federated``."""
        if not self.federated:
            return None
        count = len(self.sensors)
        shares = self.shares or (1.0 / count,) * count
        if len(shares) != count:
            raise InputError(f"shares: found {len(shares)}, expected {count}, one for each sensor")
        return Federation(tuple(shares), self.members)

    @property
    def centralised(self) -> Filter:
        """The same filter without local ones: the same estimates while nothing is isolated."""
        return replace(self, federated=False, shares=()) if self.federated else self

    @cached_property
    def members(self) -> tuple[tuple[int, ...], ...]:
        """Channels of each sensor."""
        return channel_groups("sensor", self.channels, [len(s.channels) for s in self.sensors])

    @cached_property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """Channels of each group that shares one weight, one gate and one count of recovery."""
        per_sensor = [len(sensor.channels) for sensor in self.sensors]
        return channel_groups(self.scope, self.channels, per_sensor)

    @property
    def grouped(self) -> tuple[tuple[int, ...], ...] | None:
        """Channels of each group; None where every channel is by itself."""
        return self.groups if any(len(group) > 1 for group in self.groups) else None

    @property
    def _more_parameters(self) -> tuple[Parameter, ...]:
        parts = (self.weight, self.gate, self.recovery, self.adaptation)
        own = tuple(p for part in parts if part is not None for p in part.parameters)
        return (*own, *self.weighing.floor)

    def _more_constants(self, values: Values) -> dict[str, Tensor]:
        return self.weighing.prepare(values)

    @property
    def foretold(self) -> tuple[str, ...]:
        """Inputs that only a simulation knows."""
        told = ("fault.mean", "fault.variance") if self.clairvoyant else ()
        ideal = getattr(self.adaptation, "ideal", False)
        return (*told, *(("ideal.variance", "ideal.error", "ideal.process") if ideal else ()))

    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        """Raise InputError if a known input is missing: a platform, or what is foretold."""
        super().check_inputs(inputs)
        for name in self.foretold:
            if name not in inputs:
                raise InputError(
                    f"log: found no input {name}, expected what a clairvoyant or ideal filter "
                    "is told"
                )

    def start(self, mean: Tensor, deviations: Tensor) -> Belief:
        """Initial belief from a mean (..., n) and deviations (..., n, n), memory at its start."""
        memory = self.adaptation.memory(mean, len(self.channels)) if self.adaptation else {}
        if self.recovery is not None:
            memory = memory | self.recovery.memory(mean, len(self.groups))
        return Belief(mean, deviations, memory)

    def _recovered(
        self, constants: Constants, streak: Tensor, linear: Linearised, present: Tensor
    ) -> tuple[Linearised, Tensor | None]:
        """The step with a grown covariance, or what gate and weights are widened by."""
        if self.recovery is None:
            return linear, None
        weighing = replace(self.weighing, weigh_prior=False, federation=None)

        def weights(doubted: Linearised) -> Tensor:
            return weighing.weights(constants, doubted, present)

        return self.recovery.applied(streak, linear, present, self.groups, weights, constants)

    def prior(
        self,
        constants: Constants,
        belief: Belief,
        measurement: Measurement,
        predicted: Predicted | None = None,
    ) -> Prior:
        """What a row is conditioned on: predicted, linearised, adapted, recovered."""
        if predicted is None:
            predicted = predict(self, constants, belief, measurement, self.adaptation)
        linear, present = linearise(self, constants, predicted, measurement, self.clairvoyant)
        left_out = None
        if self.federated if self.isolate is None else self.isolate:
            linear, present, left_out = isolated(self.members, linear, present)
        memory, widening = belief.memory, None
        if self.adaptation is not None:
            linear, memory = self.adaptation.before_condition(
                memory, linear, present, measurement.inputs, constants
            )
        if self.recovery is not None:
            linear, widening = self._recovered(constants, belief.memory[STREAK], linear, present)
        return Prior(linear, present, memory, widening, left_out)

    def step(
        self,
        constants: Constants,
        belief: Belief,
        measurement: Measurement,
        predicted: Predicted | None = None,
    ) -> tuple[Belief, Record]:
        """Predict to the measurement's time, linearise, weigh, condition.

        With ``predicted`` the prediction is done already; of the belief the memory counts.
        """
        prior = self.prior(constants, belief, measurement, predicted)
        linear, present, memory = prior.linear, prior.present, prior.memory
        conditioned, record = self.weighing.condition(constants, linear, present, prior.widening)
        if self.adaptation is not None:
            memory = self.adaptation.after_condition(
                memory, linear, conditioned, record.weight, present, constants
            )
        if self.recovery is not None:
            before = belief.memory[STREAK]
            streak = self.recovery.count(before, record.weight, present, self.groups)
            memory = {**memory, STREAK: streak}
        if prior.left_out is not None:
            record = record._replace(isolated=prior.left_out)
        n = linear.size
        posterior = conditioned.deviations[..., :n, :]
        if posterior.shape[-1] > n:  # common noise, cubature: static, by the recipe
            posterior = compress(posterior)
        mean, posterior = moved(self.motion, linear.mean, conditioned.shift[..., :n], posterior)
        return Belief(mean, posterior, memory), record
