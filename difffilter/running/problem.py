"""What a loss is a function of values for: a recipe, a log, and how the run is judged."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from difffilter.core.beliefs import Belief
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.scoring.losses import LossContext

__all__ = ["Problem"]


@dataclass(frozen=True)
class Problem:
    """All that turns values into a loss, but the values.

    Attributes:
        recipe: the filter that runs.
        log: z (T, m) or (T, B, m), with the recipe's channels.
        losses: weight of each loss by name.
        start: initial mean and covariance, or a belief; the log's own if None.
        context: what the losses need beside track and log.
        temperature: of the soft weights; None for the frozen, hard form.
        engine: ``torch`` differentiates backwards through the run; ``fused`` carries the
            tangents beside the state; ``auto`` as for :func:`difffilter.run`.
    """

    recipe: Recipe
    log: Log
    losses: Mapping[str, float]
    start: Start | Belief | None = None
    context: LossContext = field(default_factory=LossContext)
    temperature: float | None = None
    engine: str = "auto"
