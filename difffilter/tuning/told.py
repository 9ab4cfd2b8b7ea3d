"""The bound: filters that are told of every fault, tuned by the same loss on the same data.

Told of every fault with published noise, a filter is no bound: tuned noise may beat it.
"""

from __future__ import annotations

from difffilter.filters.recipe import Recipe
from difffilter.scenario.case import Case
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.tuning.descent import descend
from difffilter.tuning.task import Task

__all__ = ["told_tuned"]


def told_tuned(case: Case, seed: int = 0, engine: str = "auto") -> dict[str, Checkpoint]:
    """Values of each system that is told of every fault, by name: its own Q and R, tuned.

    Args:
        case: simulated; its ``[tuning]`` says how and by which loss.
        seed: of the training data, as for :func:`difffilter.tune`.
        engine: as there.
    """
    found = {}
    for name, spec in case.systems.items():
        recipe = case.system(name)
        if not spec.clairvoyant or case.world is None or not isinstance(recipe, Recipe):
            continue
        if any(parameter.tuned for parameter in recipe.declarations.values()):
            own = case.with_overrides({"tuning.system": name})
            task = Task(own, recipe, own.tuning, seed=seed, asked=engine)
            course = descend(task)
            training = {"loss": dict(own.tuning.loss), "seed": seed, "end": course.end}
            found[name] = Checkpoint(own, name, course.best.values, None, training)
    return found
