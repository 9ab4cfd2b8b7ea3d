"""A small world with two position sensors, and values for it made by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from helpers import tensor

from difffilter.filters.recipe import Recipe
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scenario.document import apply_overrides
from difffilter.scenario.scenario import read_scenario
from difffilter.verdict.evidence import Evidence, gather

WORLD: dict[str, Any] = {
    "schema": 1,
    "name": "two-receivers",
    "title": "Two receivers of a position",
    "world": {
        "dt": 1.0, "steps": 40, "position": [0.0, 0.0], "velocity": [20.0, 5.0],
        "acceleration": {"distribution": "normal", "mean": 0.0, "sigma": 1.0},
    },
    "sensors": {
        "gps": {"kind": "position", "noise": {"sigma": 3.0}},
        "radio": {"kind": "position", "noise": {"sigma": 3.0}},
    },
    "start": {"kind": "truth", "position_sigma": 3.0, "velocity_sigma": 1.0},
    "parameters": {
        "motion": {"acceleration": {"value": 1.0, "tuned": True}},
        "gps": {"sigma": {"value": [3.0, 3.0], "tuned": True}, "bias": {"value": [0.0, 0.0]}},
        "radio": {"sigma": {"value": [12.0, 12.0], "tuned": True},
                  "bias": {"value": [0.0, 0.0], "tuned": True}},
        "start": {"sigma": {"value": [3.0, 3.0, 1.0, 1.0], "tuned": True}},
    },
    "systems": {"ekf": {}},
    "tuning": {"system": "ekf"},
}  # fmt: skip


def planted(
    values: dict[str, Any], changes: dict[str, Any] | None = None, **training: Any
) -> Checkpoint:
    """A checkpoint: the published values of the world with some of them changed."""
    scenario = read_scenario(apply_overrides(WORLD, changes or {}), Path("two-receivers.toml"))
    filter = scenario.system("ekf")
    assert isinstance(filter, Recipe)
    tuned = {name: tensor(value) for name, value in values.items()}
    return Checkpoint(scenario, "ekf", filter.published() | tuned, None, training)


def judged(checkpoint: Checkpoint, **options: Any) -> Evidence:
    """Compiled: every case runs the same steps, so that one compilation serves all."""
    return gather(checkpoint, 24, 3, engine="fused", **options)


def shifted(log: Any, by: float) -> Any:
    """A log whose radio is off."""
    off = torch.tensor([0.0, 0.0, by, by], dtype=torch.float64)
    return replace(log, z=log.z + off)
