"""What a scenario file says of its evaluation: scenes, rows that count, results of others."""

from __future__ import annotations

import math
from dataclasses import dataclass

from difffilter.scenario.table import Table
from difffilter.scoring.metrics import SCORES, Score

__all__ = ["Reference", "Scene", "read_reference", "read_scene", "read_score"]


@dataclass(frozen=True)
class Scene:
    """A named stretch of a trajectory, for errors per scene: first <= k <= last."""

    name: str
    first: int
    last: int


@dataclass(frozen=True)
class Reference:
    """A result that somebody else published, for tables: not produced by this library."""

    run: str
    system: str
    rmse: float
    source: str


def read_score(top: Table) -> Score:
    rows = top.text("score", "all", choices=SCORES)
    first, last = top.numbers("score_times", 2, (-math.inf, math.inf))
    if last < first:
        top.fail("score_times", "[first, last] with first <= last")
    return Score(rows, first, last, top.names("score_states", ()))


def read_scene(table: Table) -> Scene:
    scene = Scene(table.text("name"), table.integer("first", low=1), table.integer("last", low=1))
    if scene.last < scene.first:
        table.fail("last", f"a step of first = {scene.first} or later")
    table.finish()
    return scene


def read_reference(table: Table) -> Reference:
    reference = Reference(
        table.text("run", ""),
        table.text("system"),
        table.number("rmse", above=0.0),
        table.text("source"),
    )
    table.finish()
    return reference
