"""Units that geometry tells to be wrong: found when a log is read, before anything runs."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.errors import DifffilterError, LogError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log
from difffilter.logs.units import UNITS
from difffilter.running.batch import run
from difffilter.scenario.case import Case
from difffilter.scenario.estimation import started
from difffilter.sensors.position import Position
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.stations import Range

__all__ = ["against_truth", "check_units", "unit_of"]

#: Rows with a measurement over which the filter is tried, the first ones.
ROWS = 60
#: Logs of one batch over which it is tried; with truth all are compared.
MOST = 5
#: Rows over which errors against truth are taken.
WITH_TRUTH = 4000
#: What a squared standardised innovation's median is, relative to a normal one's: impossible
#: below and above the first two, sound between the last two.
LOW, HIGH, SOUND = 1e-3, 100.0, (0.03, 20.0)
#: Median of a squared standard normal number.
NORMAL = 0.45493642311957283
#: How many times smaller the errors must be in another unit, and how many sigmas in this one.
BETTER = 10.0
TIMES = ((("ms",), 1e-3), (("us",), 1e-6), (("ns",), 1e-9))
#: s between rows, below which times are seconds: no recorder counts in minutes.
SLOW = 5.0


class Other(NamedTuple):
    """A unit that numbers of channels, or times, may be in, or one of nearly the same size."""

    columns: tuple[str, ...]
    units: tuple[str, ...]
    factor: float
    base: str


def _alike(base: str) -> tuple[tuple[tuple[str, ...], float], ...]:
    """The other units of a base, those within a fifth of each other together."""
    found: list[tuple[tuple[str, ...], float]] = []
    for unit, factor in UNITS[base].items():
        if 0.5 < factor < 2.0:
            continue
        near = next((i for i, (_, f) in enumerate(found) if 0.8 < factor / f < 1.25), None)
        if near is None:
            found.append(((unit,), factor))
        else:
            found[near] = ((*found[near][0], unit), found[near][1])
    return tuple(found)


OTHERS = {base: _alike(base) for base in ("rad", "m", "m/s", "m/s^2", "rad/s")}


def check_units(case: Case, log: Log, sure: Sequence[Collection[str]] = ()) -> None:
    """Raise LogError where numbers only make sense in another unit.

    With truth, each sensor's errors are compared in every unit. Without, the filter with its
    published values is run over the first rows: where innovations are impossibly large or small
    (their median square below ``LOW`` or above ``HIGH``), and sound in just another unit of
    a sensor, of all sensors alike or of the time, that unit is the answer.

    Args:
        case: whose system that is tuned says what is measured.
        log: z (T, B, m), as read, with the inputs that sensors read.
        sure: of each trajectory, what is not doubted: channels whose unit was stated, ``time``
            where its format was.

    Raises:
        LogError: names file and columns, the unit that fits, and what to write where.
    """
    try:
        recipe = case.system()
        if not isinstance(recipe, Filter):
            return
        log = replace(log.only(recipe.channels), start=None)
        suspects = list(_suspects(case, recipe, log))
    except DifffilterError:
        return  # whoever runs it says what is wrong
    for i, low in suspects:
        stated = sure[i] if sure else ()
        one = log.select([i])
        found = _by_truth(recipe, one.rows(0, min(log.steps, WITH_TRUTH)), stated)
        found = found or _by_filter(case, recipe, _first(one), stated, low)
        if found is not None:
            raise LogError(_text(log.names[i] if log.names else "log", found))


def _text(name: str, found: Other) -> str:
    wanted = f'units = {{ {found.columns[0]} = "{found.units[0]}" }}'
    if found.columns == ("time",):
        wanted = f'format = "{found.units[0]}"'
    return (
        f"{name}: column {', '.join(found.columns)}: found numbers that make sense in "
        f"{' or '.join(found.units)} alone, expected {found.base}; write [log] {wanted}, or there "
        f'"{found.base}" if that is what they are'
    )


def _suspects(case: Case, recipe: Filter, log: Log) -> Iterator[tuple[int, bool | None]]:
    """Trajectories that are impossible as they stand: whether too small, too large, or no start."""
    largest = _off_by(recipe, log.rows(0, min(log.steps, WITH_TRUTH)))
    some = log.select(range(min(log.trajectories, MOST)))
    levelled = _levels(case, recipe, _first(some))
    for i in range(log.trajectories):
        levels = levelled[i] if i < len(levelled) else [1.0]
        if levels and max(levels) < LOW:
            yield i, True
        elif not levels or max(levels) > HIGH:
            yield i, False if levels else None
        elif largest[i] > BETTER:
            yield i, False


def against_truth(recipe: Filter, log: Log) -> list[tuple[Sensor, int, Tensor]]:
    """Each sensor, its first channel's place, and what it would have measured without bias."""
    lead = log.z.shape[:-1]
    state = torch.full((*lead, len(recipe.bare_states)), torch.nan, dtype=log.z.dtype)
    if log.truth is not None:
        for i, name in enumerate(recipe.bare_states):
            if name in log.truth_states:
                state[..., i] = log.truth[..., log.truth_states.index(name)]
    values = dict(recipe.published(log.z.dtype))
    for name in values:
        if name.endswith(".bias"):
            values[name] = torch.zeros_like(values[name])
    constants = recipe.prepare(values, None)
    found, at = [], 0
    for sensor in recipe.bare_sensors:
        found.append((sensor, at, sensor.predict(state, log.inputs, constants)))
        at += len(sensor.channels)
    return found


def unit_of(recipe: Filter, sensor: Sensor) -> str:
    """The SI unit of a sensor's sigma; "1" where it has none."""
    name = getattr(sensor, "name", sensor.channels[0])
    declared = recipe.declarations.get(f"{name}.sigma")
    return declared.unit if declared is not None else "1"


def _off_by(recipe: Filter, log: Log) -> list[float]:
    """By trajectory: the largest of its sensors' median errors against truth, in sigmas."""
    found = [0.0] * log.trajectories
    if log.truth is None:
        return found
    values = recipe.published(log.z.dtype)
    for sensor, at, expected in against_truth(recipe, log):
        sigma = values.get(f"{getattr(sensor, 'name', '')}.sigma")
        if sigma is None or sigma.dim() > 1:
            continue
        errors = sensor.residual(log.z[..., at : at + len(sensor.channels)], expected) / sigma
        for i in range(log.trajectories):
            middle = _middle(errors[:, i])
            found[i] = max(found[i], middle if middle == middle else 0.0)
    return found


def _by_truth(recipe: Filter, log: Log, sure: Collection[str]) -> Other | None:
    """The sensor whose errors are ten sigmas, and ten times as small in another unit."""
    if log.truth is None:
        return None
    values = recipe.published(log.z.dtype)
    for sensor, at, expected in against_truth(recipe, log):
        if set(sensor.channels) & set(sure):
            continue
        z = log.z[..., at : at + len(sensor.channels)]
        sigma = values.get(f"{getattr(sensor, 'name', '')}.sigma")
        least = BETTER * float(sigma.mean()) if sigma is not None and sigma.dim() < 2 else 0.0
        now = _middle(sensor.residual(z, expected))
        if not now > least:
            continue
        base = unit_of(recipe, sensor)
        others = [Other(tuple(sensor.channels), *other, base) for other in OTHERS.get(base, ())]
        errors = [_middle(sensor.residual(z * other.factor, expected)) for other in others]
        if errors and min(errors) < now / BETTER:
            return others[errors.index(min(errors))]
    return None


def _middle(errors: Tensor) -> float:
    """Median of the absolute errors of the numbers that there are; NaN where there is none."""
    there = errors[~torch.isnan(errors)]
    return float(there.abs().median()) if len(there) >= 5 else math.nan


def _by_filter(
    case: Case, recipe: Filter, log: Log, sure: Collection[str], low: bool | None
) -> Other | None:
    """The unit in which the first rows are sound: in those that stand they are impossible."""
    interval = float(log.time.diff(dim=0).median()) if log.steps > 1 else 0.0
    if low is True and "time" not in sure and interval > SLOW:
        for units, factor in TIMES:
            if _sound(_levels(case, recipe, replace(log, time=log.time * factor))[0]):
                return Other(("time",), units, factor, "s")
    places = all(isinstance(sensor, Position) for sensor in recipe.bare_sensors)
    for other in _others(recipe, sure):
        every = set(other.columns) == set(recipe.channels)
        if low is not True and places and every:
            continue  # a larger noise than published is as good a reason
        if low is True and not (every and other.factor > 1.0):
            continue
        if low is None and other.base == "rad":
            continue  # directions that do not cross may be wrong in other ways
        changed = _in_unit(log, recipe, other)
        if _possible(recipe, changed) and _sound(_levels(case, recipe, changed)[0]):
            return other
    return None


def _possible(recipe: Filter, log: Log) -> bool:
    """Whether distances from two stations can be those of one point: a triangle closes."""
    values = recipe.published(log.z.dtype)
    constants = recipe.prepare(values, None)
    at = 0
    for sensor in recipe.bare_sensors:
        z = log.z[..., at : at + len(sensor.channels)]
        at += len(sensor.channels)
        if type(sensor) is not Range or len(sensor.stations) < 2:
            continue
        stations = sensor.located(log.inputs, constants)
        baseline = (stations[..., :-1, :] - stations[..., 1:, :]).norm(dim=-1)
        one, other = z[..., :-1], z[..., 1:]
        closed = ((one - other).abs() < 1.5 * baseline) & (one + other > 0.5 * baseline)
        there = ~torch.isnan(one + other)
        if there.any() and float((closed & there).sum()) < 0.5 * float(there.sum()):
            return False
    return True


def _sound(levels: list[float]) -> bool:
    return bool(levels) and SOUND[0] < min(levels) and max(levels) < SOUND[1]


def _first(log: Log) -> Log:
    """The first rows: until so many measured in the trajectory that has fewest."""
    measured = log.measured.cumsum(0).flatten(1)
    wanted = measured[-1].clamp(max=ROWS)
    return log.rows(0, int((measured < wanted).sum(0).max()) + 1)


def _others(recipe: Filter, sure: Collection[str]) -> Iterator[Other]:
    """Each other unit: of all sensors of one kind of number together, then of each."""
    units = {tuple(sensor.channels): unit_of(recipe, sensor) for sensor in recipe.bare_sensors}
    units = {channels: base for channels, base in units.items() if not set(channels) & set(sure)}
    for base, factors in OTHERS.items():
        alike = [channels for channels, own in units.items() if own == base]
        together = tuple(name for channels in alike for name in channels)
        for columns in dict.fromkeys([together, *alike]) if alike else ():
            for names, factor in factors:
                yield Other(columns, names, factor, base)


def _in_unit(log: Log, recipe: Filter, other: Other) -> Log:
    factors: Mapping[str, float] = dict.fromkeys(other.columns, other.factor)
    scale = torch.tensor([factors.get(name, 1.0) for name in recipe.channels], dtype=log.z.dtype)
    return replace(log, z=log.z * scale)


def _levels(case: Case, recipe: Filter, log: Log) -> list[list[float]]:
    """Of each trajectory and sensor: the median squared innovation by its variance, 1 if normal.

    None for a trajectory that has no start or is not finite.
    """
    try:
        ready = started(case, recipe, log)
        with torch.no_grad():
            record = run(recipe, ready, engine="torch").record
    except DifffilterError:
        if log.trajectories == 1:
            return [[]]
        return [_levels(case, recipe, log.select([i]))[0] for i in range(log.trajectories)]
    assert record is not None
    squared = record.innovation.square() / record.innovation_variance / NORMAL
    found: list[list[float]] = [[] for _ in range(log.trajectories)]
    at = 0
    for sensor in recipe.bare_sensors:
        own = slice(at, at + len(sensor.channels))
        at += len(sensor.channels)
        for i, levels in enumerate(found):
            there = squared[:, i, own][record.present[:, i, own]]
            if len(there) >= 5:
                levels.append(float(there.median()))
    return found
