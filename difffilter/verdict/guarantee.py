"""What a guarantee costs: values tuned on one world, on the family, and on it with guards."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from difffilter.comparison.comparison import Contestant
from difffilter.comparison.table import Row
from difffilter.comparison.worlds import Worlds, compare_family
from difffilter.errors import InputError
from difffilter.parameters.parameters import Values
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scenario.families import family
from difffilter.scenario.scenario import Scenario
from difffilter.scenario.worlds import BASE, WorldSpec
from difffilter.tuning.descent import descend
from difffilter.tuning.task import Task

__all__ = ["FAMILY", "GUARDED", "ONE", "SETS", "Guarantee", "guarantee", "tuned_sets"]

ONE, FAMILY, GUARDED = "one world", "family", "family with guards"
#: What is tuned on, from the least asked to the most.
SETS = (ONE, FAMILY, GUARDED)
#: What a member may lose where nothing guards it.
FREE = 1e9


@dataclass(frozen=True)
class Guarantee:
    """Each set of values in every member of the family.

    Attributes:
        system: that was tuned; values: by what they were tuned on.
        worlds: the held-out comparison, ratios to the published values.
    """

    system: str
    values: Mapping[str, Values]
    worlds: Worlds

    def row(self, member: str, tuned_on: str) -> Row:
        """Of one set of values in one member."""
        return self.worlds.comparisons[member].row(self.system, tuned_on)

    def worst(self, tuned_on: str) -> tuple[str, Row]:
        """The member, the base world aside, where a set of values stands worst."""
        names = [name for name in self.worlds.comparisons if name != BASE]
        name = max(names, key=lambda one: self.row(one, tuned_on).ratio)
        return name, self.row(name, tuned_on)

    def as_dict(self) -> dict[str, Any]:
        """For JSON: ratio, interval, RMSE and NEES by set and member."""
        return {
            label: {
                name: {
                    "rmse": row.rmse, "ratio": row.ratio, "ratio_ci95": list(row.ratio_ci95),
                    "nees_per_state": row.nees_per_state,
                }
                for name in self.worlds.comparisons
                for row in (self.row(name, label),)
            }
            for label in self.values
        }  # fmt: skip


def guarantee(
    checkpoint: Checkpoint, trajectories: int = 200, seed: int = 1, *, engine: str = "auto"
) -> Guarantee:
    """Tune on each of ``SETS``, and compare in every member of the scenario's family.

    Values that the checkpoint has already (by its loss, its seed and a scenario with the same
    worlds) are not tuned again.

    Args:
        trajectories, seed: held out, of each member.

    Raises:
        InputError: a scenario without simulated ``[[worlds]]``.
    """
    case = checkpoint.scenario
    if not isinstance(case, Scenario) or case.world is None or not case.worlds:
        raise InputError(f"{case.name}: has no simulated [[worlds]], expected some to guard")
    values = dict(tuned_sets(checkpoint, case, engine))
    recipe = checkpoint.published_filter
    who = [Contestant(checkpoint.system, "published", recipe)]
    who += [Contestant(checkpoint.system, label, recipe, one) for label, one in values.items()]
    worlds = compare_family(
        family(case), who, trajectories, seed, score=case.score, engine=engine
    )  # fmt: skip
    return Guarantee(checkpoint.system, values, worlds)


def tuned_sets(
    checkpoint: Checkpoint, case: Scenario, engine: str = "auto"
) -> Iterator[tuple[str, Values]]:
    """Values for each of ``SETS``, by the checkpoint's settings and seed.

    Args:
        case: the checkpoint's scenario, with its worlds.
    """
    given = dict(case.tuning.loss)
    own = "worlds" in given
    rest = {n: w for n, w in given.items() if n not in ("position", "scenes", "worlds")}
    loose = tuple(replace(spec, allow=FREE) for spec in with_base(case))
    first = {"scenes": 1.0} if case.scenes else {"position": 1.0}
    on_one = {**first, **rest} if own else given
    on_family = {"worlds": 1.0, **rest}
    asked = {ONE: (case, on_one), FAMILY: (replace(case, worlds=loose), on_family),
             GUARDED: (case, on_family)}  # fmt: skip
    for label, (world, loss) in asked.items():
        if label == (GUARDED if own else ONE):
            yield label, checkpoint.values
            continue
        settings = replace(case.tuning, loss=loss)
        task = Task(
            world, checkpoint.published_filter, settings,
            seed=int(checkpoint.training.get("seed", 0)), asked=engine,
        )  # fmt: skip
        found = descend(task).best.values
        yield label, task.held_to_guards(found).values if label == GUARDED else found


def with_base(case: Scenario) -> tuple[WorldSpec, ...]:
    """The entries of ``[[worlds]]``, the scenario's own world among them."""
    if any(spec.name == BASE for spec in case.worlds):
        return case.worlds
    return (WorldSpec(BASE, role="tune"), *case.worlds)
