"""A model of one's own: a recipe, what simulates it, how it starts. No file describes it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, NamedTuple

import torch

from difffilter.errors import InputError, shown
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.parameters.parameters import Values
from difffilter.registry import NAME
from difffilter.scenario.case import Case, SceneLike
from difffilter.scenario.settings import TuneSettings
from difffilter.scenario.table import Table
from difffilter.scenario.tuning import read_tuning
from difffilter.scoring.metrics import Score
from difffilter.start.measurements import from_measurements

__all__ = ["Model", "Simulator", "as_case", "digest", "signature", "tuning_alone"]

#: Logs of a seed and a number of trajectories: z (T, B, m), truth (T, B, q).
Simulator = Callable[[int, int], Log]


class Plain(NamedTuple):
    """What is said of a model's recipe where a scenario says it of a system."""

    note: str
    clairvoyant: bool = False
    options: Mapping[str, Any] = {}
    recipe: Mapping[str, Any] = {}


@dataclass(frozen=True)
class Model:
    """A recipe made in Python, on the road that scenarios go: tune, compare, report, save.

    Attributes:
        recipe: the filter.
        name: for files and tables.
        simulate: logs of (seed, count), or None where there are recorded logs alone.
        start: where a log without a start of its own starts: a mean (n,) with or without
            covariance for every trajectory, or a function of the log. None: from the first
            measurements (see :func:`difffilter.from_measurements`).
        factory: ``module:function`` that makes the recipe, for whoever loads frozen values.
        score: which rows count, and over which time.
        inputs: columns of known inputs that log files have; those that the recipe's sensors
            read are among them.
        tuning: settings; title, notes: for reports.

    Raises:
        InputError: a name that is none, a factory that is not ``module:function``.

    Example:
        >>> from difffilter import ConstantVelocity, Filter, Model, Position
        >>> car = Filter(ConstantVelocity(), (Position(sigma=2.0),), start_sigma=5.0)
        >>> Model(car, "car").system().channels
        ('position_1', 'position_2')
    """

    recipe: Recipe
    name: str = "model"
    simulate: Simulator | None = None
    start: Start | Callable[[Log], Start] | None = None
    factory: str = ""
    score: Score = field(default_factory=lambda: Score("all"))
    inputs: tuple[str, ...] = ()
    tuning: TuneSettings = field(default_factory=TuneSettings)
    title: str = "A model of its own"
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if not NAME.fullmatch(self.name):
            raise InputError(
                f"name: found {shown(self.name)}, expected a letter, then letters, digits, _ "
                "and -, at most 64"
            )
        module, _, function = self.factory.partition(":")
        if self.factory and not (
            function.isidentifier() and all(part.isidentifier() for part in module.split("."))
        ):
            raise InputError(f"factory: found {self.factory!r:.80}, expected module:function")
        known = dict.fromkeys((*self.inputs, *getattr(self.recipe, "inputs", ())))
        object.__setattr__(self, "inputs", tuple(known))
        object.__setattr__(self, "tuning", replace(self.tuning, system=self.name))

    @property
    def world(self) -> Simulator | None:
        """What simulates."""
        return self.simulate

    @property
    def scenes(self) -> tuple[SceneLike, ...]:
        """None."""
        return ()

    @property
    def systems(self) -> Mapping[str, Plain]:
        """The one recipe."""
        return {self.name: Plain(self.factory)}

    @property
    def document(self) -> Mapping[str, Any]:
        """What can be written down: name, factory, digest of the recipe, settings."""
        return {
            "name": self.name,
            "factory": self.factory,
            "digest": digest(self.recipe),
            "states": list(self.recipe.states),
            "channels": list(self.recipe.channels),
            "inputs": list(self.inputs),
            "score": [self.score.rows, *_bounds(self.score), *self.score.states],
            "tuning": json.loads(json.dumps(asdict(self.tuning))),
        }

    def system(self, name: str | None = None) -> Recipe:
        """The recipe; InputError for another name."""
        if name not in (None, self.name):
            raise InputError(f"system: found {name!r:.80}, expected {self.name}")
        return self.recipe

    def with_overrides(self, overrides: Mapping[str, Any]) -> Model:
        """The same with other settings: keys ``tuning.NAME``.

        Raises:
            InputError: another key, a setting that is unknown or not admissible.
        """
        settings = asdict(self.tuning)
        for key, value in overrides.items():
            room, _, name = key.partition(".")
            if room != "tuning" or not name:
                raise InputError(
                    f"{self.name}: found {key!r:.80}, expected tuning.NAME: "
                    "a model made in Python has no other keys"
                )
            inner, _, entry = name.partition(".")
            if entry:
                settings[inner] = {**settings[inner], entry: value}
            else:
                settings[inner] = value
        plain = {"tuning": json.loads(json.dumps(settings))}
        table = Table(plain, self.name).table("tuning")
        return replace(self, tuning=read_tuning(table, (self.name,)))

    def simulated(self, count: int, seed: int, purpose: str) -> Log:
        """Logs of the simulator; different purposes have seeds of their own."""
        if self.simulate is None:
            raise InputError(f"{self.name}: has no simulate to draw logs from, expected logs")
        text = hashlib.sha256(f"{seed}/{purpose}".encode()).digest()
        log = self.simulate(int.from_bytes(text[:4], "big") >> 1, count)
        if not isinstance(log, Log) or log.z.dim() != 3 or log.z.shape[1] != count:
            found = list(log.z.shape) if isinstance(log, Log) else type(log).__name__
            raise InputError(
                f"{self.name}: simulate gave {found}, expected a Log with z (T, {count}, m)"
            )
        return log

    def started(self, log: Log, values: Values | None = None) -> Log:
        """The log with a start of each trajectory."""
        if log.start is None and self.start is None:
            return replace(log, start=from_measurements(self.recipe, log, values))
        given = log.start or (self.start(log) if callable(self.start) else self.start)
        assert given is not None
        lead, n = tuple(log.z.shape[1:-1]), given.mean.shape[-1] if given.mean.dim() else 0
        if n not in (len(self.recipe.states), len(self.recipe.bare_states)):
            raise InputError(
                f"{self.name}: start: found mean of shape {list(given.mean.shape)}, "
                f"expected {len(self.recipe.bare_states)} numbers "
                f"({', '.join(self.recipe.bare_states)})"
            )
        covariance = given.covariance
        if covariance is not None:
            covariance = covariance.expand(*lead, *covariance.shape[-2:]).clone()
        return replace(
            log, start=Start(given.mean.expand(*lead, n).clone(), covariance, given.time)
        )


def _bounds(score: Score) -> list[float | None]:
    """First and last time; None for infinite."""
    both = (score.first, score.last)
    return [x if torch.isfinite(torch.tensor(x)) else None for x in both]


def as_case(case: Case | Recipe) -> Case:
    """A bare recipe as a model; scenarios and models as they are."""
    return Model(case) if isinstance(case, Recipe) else case


def tuning_alone(filter: Recipe, names: Sequence[str]) -> Recipe:
    """The filter with these parameters tuned, and no others."""
    declared = filter.declarations.items()
    changed = {name: replace(p, tuned=name in names) for name, p in declared}
    whole: Any = filter  # a dataclass, whichever it is
    return replace(whole, overrides=changed)  # type: ignore[no-any-return]


def signature(recipe: Recipe) -> dict[str, Any]:
    """What values must fit: states, channels, and each declaration's shape, set and unit."""
    return {
        "states": list(recipe.states),
        "channels": list(recipe.channels),
        "declarations": {
            name: [list(p.tensor().shape), type(p.constraint).__name__, p.unit]
            for name, p in recipe.declarations.items()
        },
    }


def digest(recipe: Recipe) -> str:
    """SHA-256 of the signature: tells recipes apart that values do not fit alike."""
    text = json.dumps(signature(recipe), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
