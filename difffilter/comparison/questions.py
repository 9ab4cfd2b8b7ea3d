"""What a log is asked without truth: its next rows, its other channels, its hidden windows."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch

from difffilter.errors import InputError
from difffilter.filters.hiding import Hiding
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.running.batch import run
from difffilter.running.interpolation import interpolated
from difffilter.running.smoothing import check_smoothable
from difffilter.scoring.foretelling import Foretold
from difffilter.scoring.hiding import hide_ahead, hide_channels, hide_windows, per_sensor
from difffilter.sensors.builtin import Position

__all__ = ["AHEAD", "NEXT", "OTHERS", "QUESTIONS", "WINDOWS", "Asked", "ask"]

NEXT, OTHERS = "next row", "left out"
AHEAD, WINDOWS = "ahead", "windows, smoothed"
#: By name, in words.
QUESTIONS = {
    NEXT: "each row from those before it",
    OTHERS: "each sensor (each channel of a single one) from the others",
    AHEAD: "windows of all channels from the rows before them",
    WINDOWS: "windows drawn at random, by the smoother, from the rows on both sides",
}
#: How often windows are asked for: each row but the first ones once.
PARTS = 4


class Asked(NamedTuple):
    """What a recipe with its values foretold of a log.

    Attributes:
        track: of the whole log.
        told: by question; unasked: why not, by question.
    """

    track: Track
    told: dict[str, Foretold]
    unasked: dict[str, str]


def ask(
    recipe: Recipe,
    log: Log,
    values: Values | None,
    seconds: float,
    *,
    temperature: float | None = None,
    engine: str = "auto",
) -> Asked:
    """Run the log, and run it again for each question that it can be asked.

    Args:
        log: (T, B, m), started; seconds: of a window.
    """

    def foretold(runner: Recipe, hidden: Log) -> Track:
        return run(runner, hidden, values, temperature=temperature, engine=engine)

    def between(runner: Recipe, hidden: Log) -> Track:
        return interpolated(recipe, hidden, values, temperature=temperature, engine=engine)

    with torch.no_grad():
        track = foretold(recipe, log)
        found = Asked(track, {}, {})
        if track.record is None:
            raise InputError(f"foretell: found {type(recipe).__name__}, expected a filter")
        found.told[NEXT] = Foretold.of(track.record)
        _try(found, OTHERS, lambda: _hidden(recipe, log), Hiding(recipe), foretold)
        _try(found, AHEAD, lambda: hide_ahead(log, seconds, PARTS), Hiding(recipe), foretold)
        _try(found, WINDOWS, lambda: _drawn(recipe, log, seconds), recipe, between)
    return found


def _try(
    found: Asked,
    question: str,
    hide: Callable[[], Log],
    runner: Recipe,
    tell: Callable[[Recipe, Log], Track],
) -> None:
    """Ask, or say why not."""
    try:
        hidden = hide()
    except InputError as error:
        found.unasked[question] = str(error)
        return
    record = tell(runner, hidden).record
    assert record is not None
    parts = hidden.trajectories // found.told[NEXT].present.shape[1]
    found.told[question] = Foretold.of(record, parts)


def _hidden(recipe: Recipe, log: Log) -> Log:
    sensors = per_sensor(recipe)
    if len(sensors) > 1:
        return hide_channels(log, sensors)
    if isinstance(recipe.sensors[0], Position):
        raise InputError(
            "left out: found one position sensor, whose axes tell nothing of each other"
        )
    return hide_channels(log)


def _drawn(recipe: Recipe, log: Log, seconds: float) -> Log:
    check_smoothable(recipe)
    return hide_windows(log, seconds, PARTS)
