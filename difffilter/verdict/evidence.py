"""What a grade rests on: held-out runs, red flags, conditions and their cures."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from difffilter.comparison.held_out import HeldOut, Outcome
from difffilter.comparison.table import Comparison, tabulate
from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.parameters.parameters import Values
from difffilter.running.smoothing import smooth
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scenario.estimation import started
from difffilter.scenario.scenario import Scenario, load_scenario
from difffilter.scenario.simulation import simulate
from difffilter.scoring.metrics import rejected
from difffilter.scoring.truth import measurement_errors, nominal_sigma
from difffilter.verdict import flags as red
from difffilter.verdict.flags import Flag
from difffilter.verdict.grade import Grade, grade, harmful
from difffilter.verdict.stresses import Condition, Stressed, conditions, stressed, under

__all__ = ["Evidence", "gather", "red_flags"]


@dataclass(frozen=True)
class Evidence:
    """Everything that was found about a checkpoint on held-out data.

    Attributes:
        held: the data; published, tuned: what both sets of values gave there.
        table: both rows; flags: red ones; stressed: under each condition.
        grade: what follows.
    """

    held: HeldOut
    published: Outcome
    tuned: Outcome
    table: Comparison
    flags: tuple[Flag, ...]
    stressed: tuple[Stressed, ...]
    grade: Grade

    def as_dict(self) -> dict[str, Any]:
        """The verdict as data."""
        row = self.table.rows[1]
        return {
            "grade": self.grade.word,
            "why": self.grade.why,
            "ratio": row.ratio,
            "ratio_ci95": list(row.ratio_ci95),
            "rmse": {"published": self.table.rows[0].rmse, "tuned": row.rmse},
            "nees_by_direction": {
                "published": dict(self.published.directions), "tuned": dict(self.tuned.directions),
            },
            "terms": [dict(vars(term)) for term in self.grade.terms],
            "flags": [flag.as_dict() for flag in self.flags],
            "conditions": [one.as_dict() for one in self.stressed],
        }  # fmt: skip


def gather(
    checkpoint: Checkpoint,
    trajectories: int = 200,
    seed: int = 1,
    *,
    log: Log | None = None,
    train: Log | None = None,
    engine: str = "auto",
) -> Evidence:
    """Run published and tuned values on held-out data and under every condition.

    Args:
        trajectories, seed: of simulated held-out data; log: recorded ones in their place.
        train: recorded logs that the values were tuned on; None draws simulated ones anew.

    Raises:
        InputError: a scenario of recordings without ``log``; a log without truth.
    """
    case, filter = _with_worlds(checkpoint), checkpoint.published_filter
    data = simulate(case, trajectories, seed, "test") if log is None else log
    held = HeldOut(case, filter, data.only(filter.channels), checkpoint.temperature, engine)
    before, after = held.outcome(), held.outcome(checkpoint.values)
    tracks = {("", "published"): before.track, ("", "tuned"): after.track}
    table = tabulate(
        case.name, tracks, held.log, wanted=("", "published"),
        seed=seed if log is None else None, score=case.score, scenes=case.scenes,
    )  # fmt: skip
    found = red_flags(checkpoint, held, (before, after))
    found += _memory(checkpoint, held, train, table, trajectories)
    tried = conditions(held, seed, trajectories=min(trajectories, 100))
    results: list[Stressed] = []
    cures: dict[str, tuple[str, ...]] = {}
    for condition in tried:
        there = under(held, condition)
        one = stressed(there, condition, checkpoint.values)
        results.append(one)
        if one.decisive and harmful(one):
            cures[one.name] = _cure(checkpoint, there, condition)
    merged = red.merged(found)
    made = grade(table.rows[0], table.rows[1], merged, results, cures)
    return Evidence(
        held=held,
        published=before,
        tuned=after,
        table=table,
        flags=tuple(merged),
        stressed=tuple(results),
        grade=made,
    )


def red_flags(
    checkpoint: Checkpoint, held: HeldOut, outcomes: tuple[Outcome, Outcome]
) -> list[Flag]:
    """All that a tuning's record and its held-out runs raise."""
    filter, values, training = held.filter, checkpoint.values, checkpoint.training
    before, after = outcomes
    both = before.rows & after.rows
    found = red.capped(training) + red.value_flags(filter.declarations, values, training)
    found += _process(filter, held.log, values)
    found += _sensors(filter, held, values, after)
    found += red.refusal_flags(rejected(before.track), rejected(after.track))
    found += red.direction_flags(before.directions, after.directions)
    sums = [torch.where(both, x.squared, 0.0).reshape(len(both), -1).sum(0) for x in outcomes]
    return found + red.luck_flags(sums[0], sums[1])


def _with_worlds(checkpoint: Checkpoint) -> Any:
    """The scenario, with the worlds that the package's own of that name states meanwhile."""
    case = checkpoint.scenario
    if not isinstance(case, Scenario) or case.worlds or case.world is None:
        return case
    with suppress(InputError):
        known = load_scenario(case.name)
        same = (known.world, known.faults, known.start) == (case.world, case.faults, case.start)
        if same and known.channels == case.channels:
            return replace(case, worlds=known.worlds)
    return case


def _process(filter: Recipe, log: Log, values: Values) -> list[Flag]:
    """Of the process noise of one step."""
    time = log.time if log.time.dim() == 1 else log.time[:, 0]
    dt = torch.diff(time).median() if len(time) > 1 else torch.ones((), dtype=time.dtype)
    mean = torch.zeros(len(filter.states), dtype=log.z.dtype)
    if log.truth is not None:
        for at, name in enumerate(filter.states):
            if name in log.truth_states:
                place = log.truth_states.index(name)
                mean[at] = log.truth[..., place].nan_to_num().flatten()[0]
    inputs = {name: x.reshape(len(x), -1)[0, 0] for name, x in log.inputs.items() if x.dim() < 3}
    size = []
    for chosen in (None, values):
        try:
            noise = filter.motion.noise(mean, dt, inputs, filter.prepare(chosen))
        except (KeyError, RuntimeError):  # it needs an input of another shape
            return []
        size.append(noise.square().sum(-1).sqrt())
    names = tuple(
        n for n, p in filter.declarations.items() if p.tuned and n.startswith("motion.") and p.noise
    )
    states = filter.motion.tangent
    return red.noise_flags(states, size[0].expand(len(states)), size[1].expand(len(states)), names)


def _sensors(filter: Recipe, held: HeldOut, values: Values, tuned: Outcome) -> list[Flag]:
    """Residuals against truth, or where it does not tell every state against the smoothed track."""
    log = held.log
    try:
        new, old = measurement_errors(filter, log, values), measurement_errors(filter, log)
    except InputError:
        ready = started(held.scenario, filter, log, values)
        track = smooth(filter, ready, values)
        log = replace(log, truth=track.mean, truth_states=filter.states)
        new, old = measurement_errors(filter, log, values), measurement_errors(filter, log)

    def centre(errors: Tensor) -> Tensor:
        return errors.reshape(-1, errors.shape[-1]).nanmedian(0).values

    sigma = [nominal_sigma(filter, log, chosen) for chosen in (None, values)]
    flat = [s.reshape(-1, s.shape[-1]).median(0).values if s.dim() > 1 else s for s in sigma]
    return red.sensor_flags(
        new, (flat[0], flat[1]), filter.channels, centre(new) - centre(old), _owners(filter)
    )


def _owners(filter: Recipe) -> Mapping[str, tuple[str, ...]]:
    """Tuned parameters of each channel's sensor."""
    tuned = {name for name, parameter in filter.declarations.items() if parameter.tuned}
    return {
        channel: tuple(p.name for p in sensor.parameters if p.name in tuned)
        for sensor in filter.sensors
        for channel in sensor.channels
    }


def _memory(
    checkpoint: Checkpoint, held: HeldOut, train: Log | None, table: Comparison, count: int
) -> list[Flag]:
    """Training against held out, on logs of training."""
    seed, data = checkpoint.training.get("seed"), checkpoint.training.get("data")
    if train is None and isinstance(seed, int) and isinstance(data, str):
        drawn = checkpoint.training.get("settings", {}).get("trajectories", count)
        with suppress(InputError):
            train = simulate(held.scenario, min(count, int(drawn)), seed, "train")
    if train is None or train.truth is None:
        return []
    there = replace(held, log=train.only(held.filter.channels), engine=held.chosen)
    ratio = there.outcome(checkpoint.values).ratio(there.outcome())
    row = table.rows[1]
    return red.memory_flags(ratio, (row.ratio, *row.ratio_ci95))


def _cure(checkpoint: Checkpoint, there: HeldOut, condition: Condition) -> tuple[str, ...]:
    """The one tuned value that, as published, avoids a harmful condition best; none if none."""
    published = there.outcome(None, condition.start)
    best: tuple[float, tuple[str, ...]] = (1.1, ())
    for name, parameter in there.filter.declarations.items():
        same = bool((parameter.tensor() == checkpoint.values[name]).all())
        if not parameter.tuned or same:
            continue
        values = {**checkpoint.values, name: parameter.tensor()}
        ratio = there.outcome(values, condition.start).ratio(published)[0]
        if ratio < best[0]:
            best = (ratio, (name,))
    return best[1]
