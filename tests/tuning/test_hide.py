"""Tuning on what is hidden from the filter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from cli_helpers import TINY

import difffilter as df
from difffilter.errors import InputError
from difffilter.filters.hiding import HIDDEN
from difffilter.tuning.task import Task


@pytest.fixture
def scenario(tmp_path: Path) -> df.Scenario:
    path = tmp_path / "tiny.toml"
    path.write_text(TINY)
    return df.load_scenario(path, {"world.steps": 6})


def test_tunes_without_truth(scenario: df.Scenario) -> None:
    """The loss of hidden channels does not rise on what validates."""
    settings = {
        "loss": {"likelihood": 1.0}, "hide": "channels", "steps": 2, "trajectories": 2,
        "validation": 2, "test": 2, "batch": 4, "evaluate_every": 2,
    }  # fmt: skip
    result = df.tune(scenario, settings=settings, engine="torch")
    training = result.checkpoint.training
    assert training["validation_loss"] <= training["validation_loss_published"]


def test_validates_on_the_same_question(scenario: df.Scenario) -> None:
    settings = replace(scenario.tuning, hide="channels", loss={"likelihood": 1.0}, trajectories=2)
    recipe = scenario.system(scenario.tuning.system)
    train, check = Task(scenario, recipe, settings).parts
    assert train.trajectories == 2 * len(recipe.channels)
    assert HIDDEN in train.inputs
    assert HIDDEN in check.log.inputs
    with pytest.raises(InputError, match="hide channels: found loss position"):
        _ = Task(scenario, recipe, replace(settings, loss={"position": 1.0})).parts
