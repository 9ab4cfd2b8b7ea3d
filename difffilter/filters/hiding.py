"""A recipe that is tested on what it is not given: hidden measurements, predicted and scored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Self

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.motions.protocol import Motion
from difffilter.parameters.parameters import Parameter, Values
from difffilter.parameters.values import Constants
from difffilter.sensors.sensor import Sensor

__all__ = ["HIDDEN", "Hiding"]

#: Input (T, ..., m): 1 where a measurement is hidden from the filter, 0 where it is given.
HIDDEN = "hidden"


@dataclass(frozen=True)
class Hiding(Recipe):
    """A recipe that is not given the measurements that the log's input ``hidden`` names.

    Its belief is that of the recipe without them. Its record has them alone: the innovation of
    each is its distance from what the rest of the log foretells, with the nominal variance. So
    every loss and measure of innovations becomes one of prediction.

    Attributes:
        recipe: what is tested.
        smoothed: whether the smoother is asked, which knows the rows after a hidden one too
            (:func:`difffilter.running.interpolation.interpolated`); a step asks the filter.
    """

    recipe: Recipe
    smoothed: bool = False

    @property
    def states(self) -> tuple[str, ...]:
        return self.recipe.states

    @property
    def channels(self) -> tuple[str, ...]:
        return self.recipe.channels

    @property
    def declarations(self) -> dict[str, Parameter]:
        return self.recipe.declarations

    @property
    def motion(self) -> Motion:
        return self.recipe.motion

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        return self.recipe.sensors

    @property
    def overrides(self) -> Mapping[str, Parameter]:
        return self.recipe.overrides

    @property
    def iterations(self) -> int:
        return self.recipe.iterations

    @property
    def foretold(self) -> tuple[str, ...]:
        return self.recipe.foretold

    @property
    def centralised(self) -> Recipe:
        return replace(self, recipe=self.recipe.centralised)

    def with_values(self, values: Values) -> Self:
        return replace(self, recipe=self.recipe.with_values(values))

    def prepare(self, values: Values | None = None, temperature: float | None = None) -> Constants:
        return self.recipe.prepare(values, temperature)

    def check_inputs(self, inputs: Mapping[str, Tensor]) -> None:
        if HIDDEN not in inputs:
            raise InputError(f"log: found no input {HIDDEN}, expected which measurements are")
        self.recipe.check_inputs(inputs)

    def start(self, mean: Tensor, deviations: Tensor) -> Belief:
        return self.recipe.start(mean, deviations)

    def step(
        self, constants: Constants, belief: Belief, measurement: Measurement
    ) -> tuple[Belief, Record]:
        """The recipe's step without what is hidden, and the record of what is."""
        hidden = measurement.inputs[HIDDEN] > 0.5
        given = measurement._replace(z=torch.where(hidden, torch.nan, measurement.z))
        tested = measurement._replace(z=torch.where(hidden, measurement.z, torch.nan))
        after, _ = self.recipe.step(constants, belief, given)
        _, record = self.recipe.step(constants, belief, tested)
        return after, record
