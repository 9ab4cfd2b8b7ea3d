"""What a tuning hides from its filter, by its settings."""

from __future__ import annotations

from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.scenario.settings import TuneSettings
from difffilter.scoring.hiding import hide_ahead, hide_channels, hide_windows, per_sensor
from difffilter.scoring.losses import LOSSES

__all__ = ["hidden"]


def hidden(log: Log, settings: TuneSettings, recipe: Recipe, seed: int) -> Log:
    """The log, as often as there are ways to hide a part of it.

    Raises:
        InputError: a loss that needs truth; as for the functions of
            :mod:`difffilter.scoring.hiding`.
    """
    if settings.hide == "nothing":
        return log
    told = [name for name in settings.loss if LOSSES[name].needs_truth]
    if told:
        free = ", ".join(n for n, loss in LOSSES.items() if not loss.needs_truth)
        raise InputError(f"hide {settings.hide}: found loss {told[0]}, expected some of {free}")
    if settings.hide == "ahead":
        return hide_ahead(log, settings.ahead)
    if settings.hide == "windows":
        return hide_windows(log, settings.ahead, seed=seed)
    if settings.hide == "channels":
        return hide_channels(log)
    return hide_channels(log, per_sensor(recipe))
