"""A filter as a pure function of one step: predict, linearise, weigh, condition."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from difffilter.adaptation.protocol import Adaptation
from difffilter.core.beliefs import Belief
from difffilter.errors import InputError
from difffilter.motions.blocks import Motion
from difffilter.parameters.constraints import Interval, Positive
from difffilter.parameters.parameters import (
    Number,
    Parameter,
    Values,
    as_number,
    check_values,
    declare,
    published_values,
)
from difffilter.robust.federation import Federation
from difffilter.robust.gate import Gate
from difffilter.robust.groups import DISTANCES, Scope, channel_groups
from difffilter.robust.recovery import Recovery
from difffilter.sensors.information import common_noise
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.stations import StationSensor
from difffilter.weights.registry import Weight, plain

if TYPE_CHECKING:
    from difffilter.filters.fusion import Fusion

__all__ = ["RULES", "STANDARDISATIONS", "Filter"]

STANDARDISATIONS = ("innovation", "noise")
RULES = ("taylor", "cubature")


@dataclass(frozen=True)
class Filter:
    """One recursive filter: the recipe. Values of its parameters come from outside.

    Attributes:
        motion, sensors: the models; channels are those of the sensors, in order.
        fusion: distributed fusion of subsystems, one for each sensor, in place of all of
            the above (see :mod:`difffilter.filters.fusion`), or None.
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
            (see :mod:`difffilter.robust.federation`); the same estimates, and a sensor that is not
            finite is isolated.
        shares: information shares of the local filters; equal if empty.
        adaptation: plug-in between predict and condition, or None.
        clairvoyant: told of every fault: the log's inputs ``fault.mean`` and
            ``fault.variance`` (..., m) are taken off the measurement and added to R; an
            infinite variance deletes the channel. A bound, not a filter to deploy.
        start_sigma: initial standard deviation of each state (parameter ``start.sigma``),
            used where a run's start has no covariance; None for no such parameter. A state
            given as 0 is known exactly: it stays 0 in tuning too.
        overrides: declarations that replace the components' own (published value, source,
            tuned or not), by name.

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

    motion: Motion
    sensors: tuple[Sensor, ...]
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
    fusion: Fusion | None = None
    linearise: str = "taylor"
    start_sigma: Number | None = None
    overrides: Mapping[str, Parameter] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.standardise is None:
            default = "noise" if self.iterations else "innovation"
            object.__setattr__(self, "standardise", default)
        if self.standardise not in STANDARDISATIONS:
            expected = " or ".join(STANDARDISATIONS)
            raise InputError(f"standardise: found {self.standardise!r}, expected {expected}")
        if self.iterations < 0:
            raise InputError(f"iterations: found {self.iterations}, expected 0 or more")
        if (self.weigh_prior or self.mad) and not self.iterations:
            raise InputError("weigh_prior and mad: expected iterations of 1 or more with them")
        if self.fusion is not None:
            self.fusion.check(self.sensors)
            beside = (
                self.weight is not plain, self.iterations, self.gate, self.recovery,
                self.adaptation, self.federated, self.clairvoyant, self.grouped,
                self.distance != "rms", self.standardise != "innovation",
            )  # fmt: skip
            if any(beside):
                raise InputError(
                    "fusion: expected no weight, scope, gate, recovery or adaptation with it"
                )
        if self.linearise not in RULES:
            raise InputError(f"linearise: found {self.linearise!r}, expected {' or '.join(RULES)}")
        if self.distance not in DISTANCES:
            expected = " or ".join(DISTANCES)
            raise InputError(f"distance: found {self.distance!r}, expected {expected}")
        if self.shares and not self.federated:
            raise InputError("shares: expected federated with them")
        _ = self.federation  # checked when the filter is made
        inflating = self.recovery is not None and self.recovery.action == "inflate"
        if inflating and self.standardise == "noise" and not self.iterations:
            # A larger P moves no weight then: it would grow for ever.
            raise InputError("recovery inflate: expected standardise innovation, or iterations")
        grouped = self.grouped  # checked when the filter is made
        if self.mad and grouped is not None:
            raise InputError("mad: expected scope channel with it")
        if getattr(self.adaptation, "independent_noise", False):
            for sensor in self.sensors:
                if common_noise(sensor):
                    raise InputError(
                        f"adaptation: found noise common to channels of {sensor.channels[0]}, "
                        "expected independent noise"
                    )
        names = self.channels
        if len(set(names)) != len(names):
            raise InputError(f"channels: found a name twice in {', '.join(names)}")
        unknown = set(self.overrides) - set(self._own)
        if unknown:
            raise InputError(
                f"{min(unknown)}: no such parameter, expected one of {', '.join(self._own)}"
            )

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the n states, the position first."""
        return self.motion.states

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the m channels, in the order of ``Measurement.z``."""
        return tuple(name for sensor in self.sensors for name in sensor.channels)

    @cached_property
    def federation(self) -> Federation | None:
        """The local filters, one for each sensor; None if not ``federated``."""
        if not self.federated:
            return None
        count = len(self.sensors)
        shares = self.shares or (1.0 / count,) * count
        if len(shares) != count:
            raise InputError(f"shares: found {len(shares)}, expected {count}, one for each sensor")
        return Federation(tuple(shares))

    @property
    def centralised(self) -> Filter:
        """The same filter without local ones: the same estimates while nothing is isolated."""
        return replace(self, federated=False, shares=()) if self.federated else self

    @cached_property
    def subsystems(self) -> tuple[Filter, ...]:
        """One plain filter per sensor, of the same motion and linearisation, for fusion."""
        bare = replace(self, fusion=None, overrides={}, start_sigma=None)
        return tuple(replace(bare, sensors=(sensor,)) for sensor in self.sensors)

    @cached_property
    def members(self) -> tuple[tuple[int, ...], ...]:
        """Channels of each sensor."""
        return channel_groups("sensor", self.channels, [len(s.channels) for s in self.sensors])

    @cached_property
    def grouped(self) -> tuple[tuple[int, ...], ...] | None:
        """Channels of each group; None where every channel is by itself."""
        per_sensor = [len(sensor.channels) for sensor in self.sensors]
        groups = channel_groups(self.scope, self.channels, per_sensor)
        return groups if any(len(group) > 1 for group in groups) else None

    @cached_property
    def _own(self) -> dict[str, Parameter]:
        parts = [
            self.motion, *self.sensors, self.weight, self.gate, self.recovery, self.adaptation,
            self.fusion,
        ]  # fmt: skip
        own = [p for part in parts if part is not None for p in part.parameters]
        if self.weigh_prior:
            meaning = "least weight of a prior row"
            own.append(
                Parameter("prior.floor", 1e-4, Interval(), source="paper 3", meaning=meaning)
            )
        if self.start_sigma is not None:
            sigma, meaning = as_number(self.start_sigma), "initial standard deviation"
            shape = torch.tensor(sigma).shape
            if shape not in ((), (len(self.states),)):
                raise InputError(
                    f"start.sigma: found shape {list(shape)}, expected one number or "
                    f"{len(self.states)} numbers"
                )
            known = sigma if isinstance(sigma, tuple) else ()
            own.append(
                Parameter(
                    "start.sigma",
                    sigma,
                    Positive(tuple(i for i, entry in enumerate(known) if entry == 0.0)),
                    "m, m/s",
                    labels=self.states if isinstance(sigma, tuple) else (),
                    meaning=meaning,
                )
            )
        return declare(own)

    @cached_property
    def declarations(self) -> dict[str, Parameter]:
        """Every parameter of the filter, by name."""
        return declare((self._own | dict(self.overrides)).values())

    def published(self, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
        """The declared values by name, in the units that their declarations name."""
        return published_values(self.declarations, dtype)

    def with_values(self, values: Values) -> Filter:
        """The same recipe with other declared values; InputError if one does not fit."""
        changed = {
            name: replace(self.declarations[name], value=as_number(value))
            for name, value in check_values(self.declarations, values).items()
        }
        return replace(self, overrides=dict(self.overrides) | changed)

    def prepare(self, values: Values | None = None, temperature: float | None = None) -> Values:
        """Constants of a run from physical values (the declared ones where missing).

        Args:
            values: by parameter name, differentiable.
            temperature: of the soft weights and gates, for training; None for the hard,
                published forms.

        Raises:
            InputError: an unknown name, a wrong shape or an inadmissible value.
        """
        given = check_values(self.declarations, values)
        dtype = next(iter(given.values())).dtype if given else torch.float64
        complete = self.published(dtype) | given
        constants = dict(complete)
        parts: tuple[Motion | Sensor | Weight, ...] = (self.motion, *self.sensors, self.weight)
        for part in parts:
            constants.update(part.prepare(complete))
        if self.gate is not None:
            constants.update(self.gate.prepare(complete, max(map(len, self.grouped or ((0,),)))))
        if self.federation is not None:
            constants.update(self.federation.prepare(self.members, dtype))
        if temperature is not None:
            constants["temperature"] = torch.tensor(temperature, dtype=dtype)
        return constants

    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        """Raise InputError if a known input is missing: a platform, or what is foretold."""
        for sensor in self.sensors:
            if isinstance(sensor, StationSensor):
                sensor.check_inputs(inputs)
        foretold = ["fault.mean", "fault.variance"] if self.clairvoyant else []
        if getattr(self.adaptation, "ideal", False):
            foretold += ["ideal.variance", "ideal.error", "ideal.process"]
        for name in foretold:
            if name not in inputs:
                raise InputError(
                    f"log: found no input {name}, expected what a clairvoyant or ideal filter "
                    "is told"
                )

    def start(self, mean: Tensor, deviations: Tensor) -> Belief:
        """Initial belief from a mean (..., n) and deviations (..., n, n), memory at its start."""
        memory = self.adaptation.memory(mean, len(self.channels)) if self.adaptation else {}
        if self.recovery is not None:
            memory = memory | self.recovery.memory(mean)
        if self.fusion is not None:
            memory = memory | self.fusion.start(self, mean, deviations)
        return Belief(mean, deviations, memory)
