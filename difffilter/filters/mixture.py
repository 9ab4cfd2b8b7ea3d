"""Several filters at once, one for each way in which the target or a sensor may behave (IMM)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from functools import cached_property

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.core.innovation import shared_log_density
from difffilter.core.linalg import semidefinite_cholesky
from difffilter.errors import InputError
from difffilter.filters.declared import Overridable
from difffilter.filters.filter import Filter
from difffilter.filters.mixing import (
    Estimate,
    estimate_of,
    exchanged,
    joined,
    joint_record,
    kept,
    least,
    normalised,
    own_constants,
    own_estimate,
    switched,
)
from difffilter.filters.prediction import predict_covariance
from difffilter.filters.recipe import Recipe, declared_start
from difffilter.motions.protocol import Motion
from difffilter.parameters.constraints import Positive, Simplex
from difffilter.parameters.parameters import Number, Parameter, Values, declare
from difffilter.parameters.values import Constants
from difffilter.registry import NAME
from difffilter.sensors.information import common_noise
from difffilter.sensors.sensor import Sensor
from difffilter.weights.registry import plain

__all__ = ["PROBABILITY", "Mixture"]

#: Memory: each mode's probability, (..., K).
PROBABILITY = "mixture.probability"


@dataclass(frozen=True)
class Mixture(Overridable, Recipe):
    """Interacting multiple models (Blom and Bar-Shalom 1988): filters that exchange estimates.

    Every mode is a :class:`Filter` of the same states and channels; they differ in motion, noise,
    sensors' parameters, weights or gates. Each row, with mode probabilities mu:

    1. *Switching.* At a rate ``modes.rate`` the mode is drawn anew from ``modes.share``, so that
       P_ij(dt) = exp(-rate dt) [i = j] + (1 - exp(-rate dt)) share_j: exact for uneven times.
    2. *Mixing.* Mode j starts from the moments of all estimates with the weights
       mu_i P_ij / c_j, c_j = sum_i mu_i P_ij: of its own where it stays, of the last output
       where it is drawn anew (:func:`difffilter.filters.mixing.exchanged`).
    3. *Each mode's own step*, weights and gates included.
    4. *Probabilities.* log mu_j = log c_j + sum_c w_c log N_jc + const, with N_jc the nominal
       density of channel c in mode j, given the channels before it.
    5. *Output.* The moments of all estimates, with the weights mu.

    **Why w_c.** A mode that rejects a measurement must not win by that, nor lose where all
    reject: w_c is the largest weight that any mode gives the channel, the same for all modes. What
    no mode believes says nothing of which mode holds; what one mode believes counts with its full
    nominal density in every mode, those that reject it included. [reconstruction]

    Attributes:
        modes: filters by name, two or more for anything to switch.
        own: patterns (``motion.*``) of the parameters that each mode has for itself, named
            ``MODE.PARAMETER``. Others are shared where the modes declare them alike.
        rate: published rate of switching, 1/s.
        share: published share of each mode in the long run, sum 1; equal if empty.
        start_sigma: as for a filter; not the modes' own.
        overrides: declarations that replace the components' own, by name.

    Raises:
        InputError: no mode, a name that is none, modes of other states or channels, shares that
            do not fit.

    Example:
        >>> from difffilter import ConstantVelocity, Filter, Mixture, Position
        >>> radar = (Position(sigma=5.0),)
        >>> calm = Filter(ConstantVelocity(2, acceleration=0.1), radar)
        >>> wild = Filter(ConstantVelocity(2, acceleration=9.0), radar)
        >>> several = Mixture({"calm": calm, "wild": wild}, rate=0.05)
        >>> print(*several.declarations, sep=chr(10))
        calm.motion.acceleration
        position.sigma
        position.bias
        wild.motion.acceleration
        modes.rate
        modes.share
    """

    modes: Mapping[str, Filter]
    own: tuple[str, ...] = ("motion.*",)
    rate: float = 0.1
    share: tuple[float, ...] = ()
    start_sigma: Number | None = None
    overrides: Mapping[str, Parameter] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.modes:
            raise InputError("modes: found none, expected one or more")
        for name in self.modes:
            if not NAME.fullmatch(name):
                raise InputError(f"modes: found name {name!r:.80}, expected a letter, then letters")
        first = next(iter(self.modes.values()))
        for name, mode in self.modes.items():
            if mode.states != first.states or mode.channels != first.channels:
                raise InputError(
                    f"modes.{name}: found states {', '.join(mode.states)} and channels "
                    f"{', '.join(mode.channels)}, expected those of the first mode"
                )
            if (mode.motion.flat, mode.error_states) != (first.motion.flat, first.error_states):
                raise InputError(
                    f"modes.{name}: found a state whose deviations are "
                    f"{', '.join(mode.error_states)}{' and wrap' * (not mode.motion.flat)}, "
                    "expected those of the first mode"
                )
        if self.share and len(self.share) != len(self.modes):
            raise InputError(
                f"modes.share: found {len(self.share)} numbers, expected {len(self.modes)}"
            )
        _ = self.declarations  # checked when it is made

    @property
    def first(self) -> Filter:
        """The first mode: its motion and sensors make starts and names."""
        return next(iter(self.modes.values()))

    @property
    def motion(self) -> Motion:
        """That of the first mode, for walks and names."""
        return self.first.motion

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """Those of the first mode, for starts and names."""
        return self.first.sensors

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the n states, alike in all modes."""
        return self.first.states

    @property
    def error_states(self) -> tuple[str, ...]:
        """Names of the rows of the deviations, alike in all modes."""
        return self.first.error_states

    @property
    def kinds(self) -> Mapping[str, str]:
        """What each state is, alike in all modes."""
        return self.first.kinds

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the m channels, alike in all modes."""
        return self.first.channels

    @property
    def mode_names(self) -> tuple[str, ...]:
        """Of the K modes, in order."""
        return tuple(self.modes)

    @property
    def iterations(self) -> int:
        """How often a step conditions beyond once, over all modes."""
        return sum(1 + mode.iterations for mode in self.modes.values()) - 1

    @cached_property
    def names(self) -> dict[str, dict[str, str]]:
        """By mode: the name here of each of the mode's parameters."""
        declared: dict[str, list[Parameter]] = {}
        for mode in self.modes.values():
            for name, parameter in mode.declarations.items():
                declared.setdefault(name, []).append(parameter)

        def here(mode: str, name: str) -> str:
            first = declared[name][0]
            # Constraints may differ: the scale of a bias is that of its sigma.
            alike = all(
                replace(other, constraint=first.constraint) == first for other in declared[name]
            )
            own = any(fnmatchcase(name, pattern) for pattern in self.own)
            return name if alike and not own else f"{mode}.{name}"

        return {
            mode: {name: here(mode, name) for name in filter.declarations if name != "start.sigma"}
            for mode, filter in self.modes.items()
        }

    @cached_property
    def _own(self) -> dict[str, Parameter]:
        count = len(self.modes)
        share = self.share or (1.0 / count,) * count
        declared: dict[str, Parameter] = {}
        for mode, filter in self.modes.items():
            for name, here in self.names[mode].items():
                declared.setdefault(here, replace(filter.declarations[name], name=here))
        rate = Parameter("modes.rate", self.rate, Positive(), "1/s", meaning="rate of switching")
        meaning = "share of each mode in the long run"
        shares = Parameter(
            "modes.share", share, Simplex(), labels=tuple(self.modes), meaning=meaning
        )
        own = [*declared.values(), rate, *([shares] if count > 1 else [])]
        if self.start_sigma is not None:
            own.append(declared_start(self.start_sigma, self.bare_states))
        return declare(own)

    def prepare(self, values: Values | None = None, temperature: float | None = None) -> Constants:
        """Constants of a run: each mode's own, named ``MODE/CONSTANT``, and the chain's."""
        complete = self.complete(values)
        constants = dict(complete)
        first = {name: complete[here] for name, here in self.names[next(iter(self.modes))].items()}
        constants.update(self.first.prepare(first, temperature).items())  # what a start reads
        for mode, filter in self.modes.items():
            own = {name: complete[here] for name, here in self.names[mode].items()}
            for name, constant in filter.prepare(own, temperature).items():
                constants[f"{mode}/{name}"] = constant
        if len(self.modes) == 1:
            constants["modes.share"] = torch.ones_like(complete["modes.rate"]).unsqueeze(0)
        return Constants(constants)

    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        """Raise InputError if a known input of a mode is missing."""
        for filter in self.modes.values():
            filter.check_inputs(inputs)

    def start(self, mean: Tensor, deviations: Tensor) -> Belief:
        """All modes at the same belief; their probabilities are the shares."""
        lead = mean.shape[:-1]
        memory = {PROBABILITY: mean.new_full((*lead, len(self.modes)), torch.nan)}
        for mode, filter in self.modes.items():
            memory |= kept(mode, estimate_of(filter.start(mean, deviations)))
        return Belief(mean, deviations, memory)

    def step(
        self, constants: Constants, belief: Belief, measurement: Measurement
    ) -> tuple[Belief, Record]:
        """One row; see the class."""
        known = belief.memory[PROBABILITY]
        known = torch.where(torch.isnan(known), constants["modes.share"], known)
        chain = switched(known, constants, measurement.dt)
        of_all = estimate_of(belief)
        after, records = [], []
        for j, mode in enumerate(self.modes):
            own = own_estimate(mode, belief.memory)
            prior = exchanged(self.motion, chain.stays[..., j], chain.fresh[..., j], of_all, own)
            posterior, record = self._of_mode(mode, constants, prior, measurement)
            after.append(posterior)
            records.append(record)
        probability = normalised(chain.predicted, self._densities(records))
        output = joined(self.motion, probability, after)
        memory = {PROBABILITY: probability.clamp_min(least(probability))}
        for mode, posterior in zip(self.modes, after, strict=True):
            memory |= kept(mode, posterior)
        record = joint_record(chain.predicted, probability, records)
        return output._replace(memory=memory), record

    def _of_mode(
        self, mode: str, constants: Constants, prior: Estimate, measurement: Measurement
    ) -> tuple[Estimate, Record]:
        """The mode's own step from what it starts from."""
        filter, own = self.modes[mode], own_constants(mode, constants)
        mean, covariance, memory = prior.mean, prior.covariance, prior.memory
        predicted = None
        if filter.adaptation is None:
            predicted = predict_covariance(filter, own, mean, covariance, measurement)
        factor = semidefinite_cholesky(covariance) if predicted is None else predicted.deviations
        after, record = filter.step(own, Belief(mean, factor, memory), measurement, predicted)
        return estimate_of(after), record

    def _densities(self, records: Sequence[Record]) -> Tensor:
        """(..., K), log density of the row in each mode, of the channels that any mode believes."""
        if self._believes_all:
            each = [
                shared_log_density(r.observed, r.noise, r.innovation, r.present) for r in records
            ]
            return torch.stack(each, dim=-1)
        believed = torch.stack([record.weight for record in records]).amax(0)
        return torch.stack([(believed * r.log_densities).sum(-1) for r in records], dim=-1)

    @property
    def _believes_all(self) -> bool:
        """Whether some mode gives every channel weight 1, and noise of no channel can be 0."""
        common = any(common_noise(s) for mode in self.modes.values() for s in mode.sensors)
        trusting = any(mode.weight == plain and mode.gate is None for mode in self.modes.values())
        return trusting and not common
