"""The ``[tuning]`` table of a scenario."""

from __future__ import annotations

from collections.abc import Sequence

from difffilter.scenario.settings import HIDES, OPTIMISERS, TuneSettings
from difffilter.scenario.table import Table
from difffilter.scoring.losses import LOSSES

__all__ = ["read_tuning"]


def read_tuning(table: Table, systems: Sequence[str]) -> TuneSettings:
    """Read ``[tuning]``; every key is optional."""
    base = TuneSettings()
    losses = table.table("loss", optional=True)
    for name in losses.data:
        if name not in LOSSES:
            losses.fail(name, f"a loss among {LOSSES.names}")
    weights = {name: losses.number(name, low=0.0) for name in losses.data}
    loss = {name: weight for name, weight in weights.items() if weight}
    if weights and not loss:
        table.fail("loss", "a weight above 0")
    temperature = table.numbers("temperature", 2, base.temperature)
    if not temperature[0] >= temperature[1] > 0.0:
        table.fail("temperature", "two numbers [first, last] with first >= last > 0")
    settings = TuneSettings(
        system=table.text("system", systems[0], choices=tuple(systems)),
        loss=loss or base.loss,
        optimiser=table.text("optimiser", base.optimiser, choices=OPTIMISERS),
        trajectories=table.integer("trajectories", base.trajectories, low=1),
        validation=table.integer("validation", base.validation, low=1),
        test=table.integer("test", base.test, low=2),
        batch=table.integer("batch", base.batch, low=1),
        steps=table.integer("steps", base.steps, low=0),
        runs=table.number("runs", base.runs, low=0.0),
        learning_rate=table.number("learning_rate", base.learning_rate, above=0.0),
        clip=table.number("clip", base.clip, above=0.0),
        temperature=(temperature[0], temperature[1]),
        evaluate_every=table.integer("evaluate_every", base.evaluate_every, low=1),
        patience=table.integer("patience", base.patience, low=1),
        starts=table.integer("starts", base.starts, low=1),
        scatter=table.number("scatter", base.scatter, above=0.0),
        degrees=table.number("degrees", base.degrees, above=0.0),
        hide=table.text("hide", base.hide, choices=HIDES),
        ahead=table.number("ahead", base.ahead, above=0.0),
        window=table.integer("window", base.window, low=2),
        refresh=table.integer("refresh", base.refresh, low=1),
    )
    table.finish()
    return settings
