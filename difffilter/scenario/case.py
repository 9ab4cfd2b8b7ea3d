"""What tuning, comparison and verdict ask of their subject: a scenario, or a model of one's own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

from difffilter.scenario.build import System
from difffilter.scenario.settings import TuneSettings
from difffilter.scoring.metrics import Score

__all__ = ["Case", "SceneLike"]


class SceneLike(Protocol):
    """A named stretch of a trajectory: first <= k <= last."""

    @property
    def name(self) -> str:
        """Of the scene."""

    @property
    def first(self) -> int:
        """First step, from 1."""

    @property
    def last(self) -> int:
        """Last step."""


class Case(Protocol):
    """Recipes, how their logs are made and started, and how results are scored.

    A :class:`difffilter.Scenario` is one, a :class:`difffilter.Model` the other. Logs come from
    :func:`difffilter.simulate`, starts from :func:`difffilter.started`, for either.
    """

    @property
    def name(self) -> str:
        """Short name, for files and tables."""

    @property
    def title(self) -> str:
        """One line."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Further lines."""

    @property
    def document(self) -> Mapping[str, Any]:
        """Plain data that say all of it that can be written down: its identity."""

    @property
    def world(self) -> Any:
        """What simulates; None where there are recorded logs alone."""

    @property
    def systems(self) -> Mapping[str, Any]:
        """Recipes by name; each says whether it is ``clairvoyant``."""

    @property
    def scenes(self) -> tuple[SceneLike, ...]:
        """Stretches that are scored apart."""

    @property
    def score(self) -> Score:
        """Which rows count."""

    @property
    def tuning(self) -> TuneSettings:
        """How it is tuned."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Columns of known inputs in logs."""

    def system(self, name: str | None = None) -> System:
        """A recipe by name; the one to tune if None."""

    def with_overrides(self, overrides: Mapping[str, Any]) -> Case:
        """The same with dotted keys changed, checked."""
