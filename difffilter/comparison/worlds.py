"""Systems and sets of values in every world of a family."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor
from tqdm import tqdm

from difffilter.comparison.comparison import Contestant, contestants, resolved, run_all
from difffilter.comparison.table import Comparison, Row, labelled, tabulate
from difffilter.errors import InputError
from difffilter.escape import markdown_table
from difffilter.logs.family import Family, Member
from difffilter.logs.log import Log
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scenario.families import family
from difffilter.scenario.scenario import Scenario
from difffilter.scoring.metrics import Score
from difffilter.start.measurements import from_measurements

__all__ = ["Worlds", "compare_family", "compare_worlds"]


@dataclass(frozen=True)
class Worlds:
    """Result of :func:`compare_family`.

    Attributes:
        family: the worlds; comparisons: one for each, by its name.
    """

    family: Family
    comparisons: Mapping[str, Comparison]

    def worst(self, system: str, values: str) -> tuple[str, Row]:
        """The world where a system and its values stand worst, and its row there.

        Raises:
            InputError: no such row.
        """
        rows = {name: one.row(system, values) for name, one in self.comparisons.items()}
        return max(rows.items(), key=lambda item: item[1].ratio)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            "worlds": [
                {
                    "name": member.name,
                    "role": member.role,
                    "weight": member.weight,
                    "allow": member.allow,
                    "plausible": member.plausible,
                    **self.comparisons[member.name].as_dict(),
                }
                for member in self.family
            ]
        }

    def markdown(self) -> str:
        """One table: a row for each world, system and set of values."""
        unit = next(iter(self.comparisons.values())).unit
        head = [
            "world", "system", "values", labelled("RMSE", unit), "ratio to published",
            "95 % interval", "NEES per state", "allowed",
        ]  # fmt: skip
        rows = []
        for member in self.family:
            for row in self.comparisons[member.name].rows:
                low, high = row.ratio_ci95
                cells = [
                    member.name, row.system, row.values, f"{row.rmse:.4g}", f"{row.ratio:.3f}",
                    f"{low:.3f} to {high:.3f}", f"{row.nees_per_state:.2f}", f"{member.allow:g}",
                ]  # fmt: skip
                rows.append(cells)
        return "\n".join(markdown_table(head, rows)) + "\n"


def compare_worlds(
    scenario: Scenario,
    values: Mapping[str, Checkpoint | None] | None = None,
    trajectories: int = 200,
    seed: int = 1,
    *,
    log: Log | None = None,
    systems: tuple[str, ...] = (),
    progress: bool = False,
    engine: str = "auto",
) -> Worlds:
    """:func:`difffilter.compare` in every world of a scenario's family.

    Each system with a checkpoint's values is relative to the same system with the published
    ones, in the same world.

    Args:
        scenario, values, trajectories, seed, systems, engine: as for ``compare``; by default
            only systems with values of a checkpoint, or the one that is tuned.
        log: recorded logs, whose groups are the worlds.

    Raises:
        InputError: as for ``compare``; a scenario without worlds and no log.
    """
    values = {"published": None} if values is None else dict(values)
    frozen = {checkpoint.system for checkpoint in values.values() if checkpoint is not None}
    systems = resolved(scenario, systems) or tuple(frozen or {scenario.tuning.system})
    return compare_family(
        family(scenario, log),
        contestants(scenario, {"published": None} | values, systems),
        trajectories,
        seed,
        score=scenario.score,
        progress=progress,
        engine=engine,
    )


def compare_family(
    worlds: Family,
    who: Iterable[Contestant],
    trajectories: int = 200,
    seed: int = 1,
    *,
    score: Score | str = "all",
    progress: bool = False,
    engine: str = "auto",
) -> Worlds:
    """Recipes and sets of values in every world of a family.

    Args:
        who: recipes with their values. A row's ratio is relative to the same system with
            ``published`` values, else to the first one.
        trajectories, seed: of simulated logs, with the purpose ``test``: disjoint from
            training and validation whatever the seed.
        score: which rows count.

    Raises:
        InputError: a log without truth, or in which nobody has an estimate; names the world.

    Example:
        >>> import torch
        >>> from difffilter import ConstantVelocity, Contestant, Family, Filter, Log, Member
        >>> from difffilter import Position, compare_family
        >>> sensor = Position(axes=1, sigma=2.0)
        >>> filter = Filter(ConstantVelocity(1), (sensor,), start_sigma=(9.0, 3.0))
        >>> time = torch.arange(20, dtype=torch.float64)
        >>> truth = torch.stack([time, torch.ones_like(time)], -1).unsqueeze(1)
        >>> def log(off):
        ...     return Log(filter.channels, time, truth[..., :1] + off, truth, ("x", "vx"))
        >>> worlds = Family((Member("fair", log(0.0)), Member("biased", log(5.0), role="guard")))
        >>> found = compare_family(worlds, [Contestant("mine", "published", filter)])
        >>> found.comparisons["biased"].row("mine").rmse > 4.0
        True
    """
    chosen = list(who)
    if not chosen:
        raise InputError("compare: found nobody, expected one system or more")
    bar = tqdm(worlds, desc="worlds", unit="world", delay=2.0, disable=not progress)
    return Worlds(
        worlds,
        {
            member.name: _one(member, chosen, trajectories, seed, score=score, engine=engine)
            for member in bar
        },
    )


def _one(
    member: Member,
    who: list[Contestant],
    trajectories: int,
    seed: int,
    *,
    score: Score | str,
    engine: str,
) -> Comparison:
    log = member.log(trajectories, seed, "test")
    if log.truth is None:
        raise InputError(f"world {member.name}: needs truth columns in the logs, found none")
    wanted = (who[0].system, "published")
    try:
        tracks = run_all(who, log, member.starter or started_by_measurements, engine)
        seen = None if member.recorded else seed
        return tabulate(member.name, tracks, log, wanted=wanted, seed=seen, score=score)
    except InputError as error:
        raise InputError(f"world {member.name}: {error}") from None


def started_by_measurements(recipe: Any, log: Log, values: Mapping[str, Tensor] | None) -> Log:
    """The log with a start: its own, else one from its first measurements."""
    log = log.only(recipe.channels)
    if log.start is not None:
        return log
    with torch.no_grad():
        return replace(log, start=from_measurements(recipe, log, values))
