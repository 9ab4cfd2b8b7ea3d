"""The step that streaming, batch runs and training all execute."""

from __future__ import annotations

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.filters.recipe import Recipe
from difffilter.parameters.values import Constants

__all__ = ["step"]


def step(
    recipe: Recipe, constants: Constants, belief: Belief, measurement: Measurement
) -> tuple[Belief, Record]:
    """One time step: predict to the measurement's time, linearise, weigh, condition.

    Pure: torch operations of static shape on (..., n) tensors, no hidden state, no branch on a
    tensor's value. Branches are on the recipe alone.

    Args:
        recipe: a :class:`Filter`, or another :class:`Recipe`.
        constants: from :meth:`Recipe.prepare`.
        belief: at the previous time, mean (..., n).
        measurement: z (..., m) with NaN where a channel is missing, dt, known inputs.

    Returns:
        The belief after the measurement, and the record of what was done. Nothing is checked
        here: a belief may turn out not finite (:func:`difffilter.run` raises then).
    """
    return recipe.step(Constants.of(constants), belief, measurement)
