"""Conditions that nobody tuned for: manoeuvres, noise, faults, a wrong start, other rates."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch

from difffilter.comparison.held_out import HeldOut, as_it_is
from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.parameters.parameters import Values
from difffilter.scenario.case import Case
from difffilter.scenario.families import family
from difffilter.scenario.scenario import Scenario
from difffilter.scenario.worlds import BASE, WorldSpec, changed
from difffilter.verdict import changed_logs as change

__all__ = ["CONDITIONS", "NOT_STATED", "Condition", "Stressed", "conditions", "stress"]

#: Plausibility of a condition of which the scenario says nothing.
NOT_STATED = "not stated"
#: deg/s of a turn, at least; and times the sharpest turn of the world.
TURN, SHARPER = 3.0, 4.0


@dataclass(frozen=True)
class Condition:
    """One way in which the world may differ from the one that was tuned on.

    Attributes:
        name: short, of the trade.
        text: in plain words.
        monitor: what tells in operation that it holds.
        plausible: why it may happen, or ``NOT_STATED``.
        decisive: whether it alone can forbid a plain adopt; else it is shown.
        log: makes the log from the held-out one, before the start.
        start: changes the started log.
        case: whose start and score count; None for that of the held-out data.
    """

    name: str
    text: str
    monitor: str
    plausible: str = NOT_STATED
    decisive: bool = True
    log: Callable[[Log], Log] = as_it_is
    start: Callable[[Log], Log] = as_it_is
    case: Case | None = None


@dataclass(frozen=True)
class Stressed:
    """Two sets of values under one condition.

    Attributes:
        name, text, monitor, plausible, decisive: of the :class:`Condition`.
        published, tuned: RMSE of the scored states, in ``unit``; nees: of both, per state.
        ratio: tuned / published, with its paired 95 % interval.
        directions: NEES of published and tuned along each principal direction of P.
    """

    name: str
    text: str
    monitor: str
    plausible: str
    decisive: bool
    published: float
    tuned: float
    nees: tuple[float, float]
    ratio: tuple[float, float, float]
    directions: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    unit: str = "m"

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {**vars(self), "directions": dict(self.directions)}


#: Those that are made of the log alone: name, text, what tells, and the change.
CONDITIONS: tuple[tuple[str, str, str, Callable[[Recipe, Log, float, int], Log], float], ...] = (
    ("noise halved", "half the measurement noise", "the spread of the innovations",
     change.noisier, 0.5),
    ("noise doubled", "twice the measurement noise", "the spread of the innovations",
     change.noisier, 2.0),
    ("correlated errors", "errors correlated by 0.8 from row to row, in place of white ones",
     "the correlation of successive innovations", change.correlated, change.CORRELATION),
    ("a channel lost", "one channel missing at any time, each third another",
     "the share of missing measurements", change.losing_channels, 0.0),
    ("half the rate", "every second measurement of each channel missing", "the rate of rows",
     change.sparser, 0.0),
    ("twice the rate", "a row between any two", "the rate of rows", change.denser, 0.0),
)  # fmt: skip
OUTLIERS = ((0.05, "outliers"), (0.1, "outliers doubled"))
MONITOR_MANOEUVRE = "the mean of the innovations over 10 rows: it leaves 0 in a manoeuvre"
MONITOR_FAULTS = "the share of measurements with a weight below 0.1"


def stress(held: HeldOut, tuned: Values, found: list[Condition] | None = None) -> (
    Iterator[Stressed]
):  # fmt: skip
    """Published and tuned values under each condition.

    Args:
        held: out, with truth.
        found: conditions; by default all that :func:`conditions` finds.
    """
    for condition in conditions(held) if found is None else found:
        yield stressed(under(held, condition), condition, tuned)


def stressed(there: HeldOut, condition: Condition, tuned: Values) -> Stressed:
    """Published and tuned values under one condition, over the rows that both have.

    Args:
        there: the data as the condition changes them (see :func:`under`).
    """
    published, other = (there.outcome(v, condition.start) for v in (None, tuned))
    both = published.rows & other.rows
    error = [float(x.squared[both].mean().sqrt()) for x in (published, other)]
    return Stressed(
        **{n: getattr(condition, n) for n in ("name", "text", "monitor", "plausible", "decisive")},
        published=error[0], tuned=error[1], nees=(published.nees, other.nees),
        ratio=other.ratio(published),
        directions={
            name: (published.directions.get(name, math.nan), value)
            for name, value in other.directions.items()
        },
        unit=published.unit,
    )  # fmt: skip


def under(held: HeldOut, condition: Condition) -> HeldOut:
    """The held-out data as a condition changes them."""
    log = condition.log(held.log).only(held.filter.channels)
    case = condition.case or held.scenario
    return replace(held, log=log, scenario=case, engine=held.chosen)


def conditions(held: HeldOut, seed: int = 0, trajectories: int = 100) -> list[Condition]:
    """What is tested: the scenario's own worlds, then what every log can be changed into.

    No condition stands twice: a world that the scenario states takes the place of its like.

    Args:
        held: the data; its first trajectories are changed.
        trajectories: of each condition, at most.
    """
    filter = held.filter
    found = [*_worlds(held.scenario, filter, seed, trajectories)]
    if held.log.z.dim() > 2 and held.log.trajectories > trajectories:
        few: Callable[[Log], Log] = lambda log: log.select(range(trajectories))  # noqa: E731
    else:
        few = lambda log: log  # noqa: E731
    found += _manoeuvres(held, few(held.log))
    for name, text, monitor, make, level in CONDITIONS:
        changed_log = make(filter, few(held.log), level, seed)
        if not torch.equal(changed_log.z.nan_to_num(), few(held.log).z.nan_to_num()):
            found.append(Condition(name, text, monitor, log=_always(changed_log)))
    found.append(
        Condition("start off", "a start off by three sigmas in every state",
                  "NIS in the first rows", log=few,
                  start=lambda log: change.moved_start(filter, log, 3.0, seed))
    )  # fmt: skip
    if not (isinstance(held.scenario, Scenario) and held.scenario.faults):
        for share, name in OUTLIERS:
            text = f"{100 * share:g} % of the measurements off by 5 to 20 sigmas"
            wild = _always(change.wilder(filter, few(held.log), share, seed))
            found.append(Condition(name, text, MONITOR_FAULTS, decisive=False, log=wild))
    return found


def _manoeuvres(held: HeldOut, log: Log) -> list[Condition]:
    """Accelerations and a turn; none where the truth does not tell every state."""
    filter = held.filter
    try:
        usual = change.sustained(filter, log.only(filter.channels))
    except InputError:
        return []
    except ValueError:  # a state without a velocity: nothing to push
        return []
    if not (math.isfinite(usual) and usual > 0.0):
        return []

    def pushed(times: float, across: bool) -> Callable[[Log], Log]:
        return lambda _: change.pushed(filter, log, times * usual, across)

    found = []
    ways = ("along", "across") if "y" in filter.states else ("along",)
    for way in ways:
        for times, word in ((2.0, "twice"), (4.0, "four times")):
            text = f"accelerations {way} the path, {times * usual:.2g} m/s^2 for ten rows each "
            text += f"way: {word} what the truth sustains"
            found.append(
                Condition(f"{word} the acceleration {way}", text, MONITOR_MANOEUVRE,
                          decisive=times < 4.0, log=pushed(times, way == "across"))
            )  # fmt: skip
    if "y" in filter.states:
        rate = max(TURN, SHARPER * _sharpest(held.scenario))
        found.append(
            Condition("a turn", f"weaving at {rate:g} deg/s, 60 degrees to either side",
                      MONITOR_MANOEUVRE,
                      log=lambda _: change.turned(filter, log, math.radians(rate)))
        )  # fmt: skip
    return found


def _sharpest(case: Case) -> float:
    """deg/s of the sharpest turn of a simulated world."""
    segments = getattr(case.world, "segments", ())
    return max((abs(math.degrees(part.turn_rate)) for part in segments), default=0.0)


def _worlds(case: Case, filter: Recipe, seed: int, trajectories: int) -> Iterator[Condition]:
    """Worlds that a scenario states, then its faults off, halved and doubled."""
    if not isinstance(case, Scenario) or case.world is None:
        return
    stated = [spec for spec in case.worlds if not spec.logs and spec.name != BASE]
    known = [_truth(changed(case, spec)) for spec in stated]
    for text, factor in (("off", 0.0), ("halved", 0.5), ("doubled", 2.0)):
        times = {
            f"faults.{name}.probability": factor
            for name in case.faults
            if "probability" in dict(case.document["faults"][name])
        }
        if factor == 0.0:
            off = replace(case, faults={}, worlds=())
            if case.faults and not any(_truth(off) == one or not one[1] for one in known):
                yield _simulated(case, off, WorldSpec("faults off", plausible=NOT_STATED), seed,
                                 trajectories)  # fmt: skip
        elif times:
            spec = WorldSpec(f"faults {text}", plausible=NOT_STATED, times=times)
            if _truth(changed(case, spec)) not in known:
                yield _simulated(case, changed(case, spec), spec, seed, trajectories)
    for member in family(case):
        if member.name != BASE:
            spec = next(one for one in stated if one.name == member.name)
            log = member.log(trajectories, seed, "test")
            yield Condition(
                member.name, f"world {member.name}", _telling(spec),
                member.plausible or NOT_STATED, log=_always(log), case=changed(case, spec),
            )  # fmt: skip


def _simulated(
    case: Scenario, world: Scenario, spec: WorldSpec, seed: int, trajectories: int
) -> Condition:
    from difffilter.scenario.simulation import simulate

    log = simulate(world, trajectories, seed, f"test:{spec.name}")
    text = f"the world's {spec.name}"
    return Condition(spec.name, text, MONITOR_FAULTS, log=_always(log), case=world)


def _always(log: Log) -> Callable[[Log], Log]:
    return lambda _: log


def _truth(world: Scenario) -> tuple[Any, ...]:
    """What two worlds that are the same share."""
    struck = {n: f for n, f in world.faults.items() if f.probability > 0.0}
    return (world.world, struck, world.start, _noise(world))


def _noise(world: Scenario) -> Any:
    return {name: (sensor.sigma, str(sensor)) for name, sensor in world.sensors.items()}


def _telling(spec: WorldSpec) -> str:
    keys = " ".join((*spec.overrides, *spec.times))
    if "faults" in keys:
        return MONITOR_FAULTS
    if "acceleration" in keys or "segments" in keys or "velocity" in keys:
        return MONITOR_MANOEUVRE
    if "start" in keys:
        return "NIS in the first rows"
    return "NIS per channel: it leaves its usual value"
