"""Is the gradient worth it? The same tuning, by other means, with the same budget."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace

import torch

from difffilter.comparison.held_out import HeldOut, Outcome
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.parameters.parameters import Values
from difffilter.scenario.case import Case
from difffilter.scenario.estimation import started
from difffilter.scenario.model import tuning_alone
from difffilter.scenario.settings import TuneSettings
from difffilter.scenario.simulation import simulate
from difffilter.scoring.losses import total_loss
from difffilter.tuning.descent import descend
from difffilter.tuning.search import SEARCHES
from difffilter.tuning.task import Task
from difffilter.verdict.noise_estimates import (
    noise_names,
    plain_filter,
    sample_covariances,
)

__all__ = ["SAMPLE", "Contender", "Course", "contenders", "contest"]

#: Runs of the others, in those of the gradient.
BUDGET = 1.0
#: Name of the contender that truth alone gives.
SAMPLE = "Q and R: sample covariances of the true errors"
#: Training and validation trajectories, at most: every method has the same.
TRAJECTORIES, VALIDATION = 128, 64


@dataclass(frozen=True)
class Course:
    """How one tuning went, judged on held-out data.

    Attributes:
        method: optimiser's name; seed: of its training data and its own draws.
        runs, seconds: spent before each validation.
        loss: held out, of the values that validation had found best by then.
        rmse: their held-out position RMSE, m.
    """

    method: str
    seed: int
    runs: tuple[float, ...]
    seconds: tuple[float, ...]
    loss: tuple[float, ...]
    rmse: tuple[float, ...]

    def at(self, *, runs: float = float("inf"), seconds: float = float("inf")) -> int:
        """The last validation within a budget."""
        inside = [r <= runs and s <= seconds for r, s in zip(self.runs, self.seconds, strict=True)]
        return max(sum(inside) - 1, 0)


def contest(
    scenario: Case,
    filter: Recipe,
    settings: TuneSettings,
    held: HeldOut,
    *,
    seeds: Sequence[int] = (0,),
    methods: Sequence[str] = tuple(SEARCHES),
    log: Log | None = None,
    engine: str = "auto",
) -> Iterator[Course]:
    """Tune with the gradient, then with each other method on ``BUDGET`` times its filter runs.

    All minimise the same loss of the same training data from the same start, and keep what the
    same validation data find best. The searches see the frozen, hard form at once. Compiling
    is not timed.

    Args:
        held: data that none of them sees.
        seeds: one tuning each.
        log: recorded logs to train on.

    Raises:
        InputError: a package that is missing; as :func:`difffilter.tune`.
    """
    settings = replace(
        settings,
        trajectories=min(settings.trajectories, TRAJECTORIES),
        validation=min(settings.validation, VALIDATION),
    )
    warm(scenario, filter, settings, log, engine)
    for seed in seeds:
        task = Task(scenario, filter, settings, seed=seed, train=log, asked=engine)
        found, spent = _course(task, held)
        yield found
        budget = BUDGET * spent
        for method in methods:
            other = replace(settings, optimiser=method, runs=budget, steps=10**6, starts=1)
            yield _course(replace(task, settings=other), held)[0]


def warm(
    scenario: Case, filter: Recipe, settings: TuneSettings, log: Log | None, engine: str
) -> None:
    """Compile what the contest runs, before any clock starts."""
    small = replace(settings, trajectories=2, validation=2, batch=2, steps=1, starts=1)
    for name in (settings.optimiser, "random"):
        chosen = replace(small, optimiser=name, runs=1.0)
        descend(Task(scenario, filter, chosen, train=log, asked=engine))


def _course(task: Task, held: HeldOut) -> tuple[Course, float]:
    """One tuning, and the filter runs that it spent."""
    found = descend(task)
    best, judged, losses, errors = float("inf"), (0.0, 0.0), [], []
    rows = task.referred(started(task.case, task.recipe, held.log))
    for entry in found.entries:
        if entry.validation < best:
            best = entry.validation
            values = {n: torch.tensor(v, dtype=torch.float64) for n, v in entry.values.items()}
            outcome = held.outcome(values)
            loss, _ = total_loss(task.settings.loss, outcome.track, rows, task.context)
            judged = (float(loss), outcome.rmse)
        losses.append(judged[0])
        errors.append(judged[1])
    course = Course(
        task.optimiser,
        task.seed,
        tuple(entry.runs for entry in found.entries),
        found.seconds,
        tuple(losses),
        tuple(errors),
    )
    return course, found.spent.runs


@dataclass(frozen=True)
class Contender:
    """One way to choose values, on held-out data.

    Attributes:
        name: what was estimated, and how.
        values: of the whole filter; outcome: what they gave.
    """

    name: str
    values: Values
    outcome: Outcome


def contenders(
    scenario: Case,
    filter: Recipe,
    settings: TuneSettings,
    held: HeldOut,
    tuned: Values,
    *,
    seed: int = 0,
    log: Log | None = None,
    engine: str = "auto",
) -> list[Contender]:
    """Q and R alone, as others estimate them, beside all values tuned.

    In order: published; Q and R by sample covariances of the true errors; by maximum
    likelihood of the plain filter's innovations (jointly normal); by the gradient of the
    scenario's own loss; all but Q and R by that gradient; all. Where Q and R alone are
    estimated, clipping points, gates, biases and credibility stay as published. The sample
    is left out where no truth tells a state of the filter.

    Args:
        tuned: all values tuned.
        seed, log: of the training data, as for :func:`difffilter.tune`.
    """
    published, noise = filter.published(), noise_names(filter)
    made: dict[str, Values] = {"published": published}
    if noise:
        train = log or simulate(scenario, settings.trajectories, seed, "train")
        if isinstance(filter, Filter):
            with suppress(InputError):  # a state that no truth tells has no sample
                made[SAMPLE] = {**published, **sample_covariances(filter, train)}
            likely = replace(settings, loss={"normal-likelihood": 1.0}, optimiser="lbfgs")
            bare = tuning_alone(plain_filter(filter), noise)
            found = _fit(scenario, bare, likely, seed, log, engine)
            made["Q and R: maximum likelihood of a plain filter"] = {
                **published, **{name: found[name] for name in noise}
            }  # fmt: skip
        alone = tuning_alone(filter, noise)
        name = "Q and R: gradient of this loss"
        made[name] = _fit(scenario, alone, settings, seed, log, engine)
    others = [n for n, p in filter.declarations.items() if p.tuned and n not in noise]
    if others and noise:
        rest = tuning_alone(filter, others)
        made["all but Q and R: gradient"] = _fit(scenario, rest, settings, seed, log, engine)
    made["all: gradient"] = tuned
    return [Contender(name, values, held.outcome(values)) for name, values in made.items()]


def _fit(
    scenario: Case,
    filter: Recipe,
    settings: TuneSettings,
    seed: int,
    log: Log | None,
    engine: str,
) -> Values:
    task = Task(scenario, filter, settings, seed=seed, train=log, asked=engine)
    return descend(task).best.values
