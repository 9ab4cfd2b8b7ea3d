"""The system that is told of every fault, with the values of another one."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from difffilter import Checkpoint, compare, load_scenario
from difffilter.cli.main import main
from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.scenario.checkpoint import save

SCENARIO = load_scenario("airport-mlat-intermittent", {"world.steps": 15, "worlds": []})


def mine() -> Checkpoint:
    """A checkpoint of the M-EKF."""
    filter = SCENARIO.system("m-ekf")
    assert isinstance(filter, Recipe)
    sigma = torch.tensor(4.0, dtype=torch.float64)
    return Checkpoint(SCENARIO, "m-ekf", filter.published() | {"tdoa.sigma": sigma})


def test_told_runs_the_q_and_r_of_the_values_that_are_named() -> None:
    found = compare(
        SCENARIO, {"published": None, "mine": mine()}, 4, systems=("told",), engine="torch"
    )
    assert [(row.system, row.values) for row in found.rows] == [
        ("clairvoyant", "published"), ("clairvoyant", "mine")
    ]  # fmt: skip
    ns = 4.0 / 0.299792458  # of 4 m
    other = SCENARIO.with_overrides({"parameters.tdoa.sigma.value": ns})
    same = compare(
        other, {"published": None}, 4, systems=("clairvoyant",), engine="torch"
    ).row("clairvoyant")  # fmt: skip
    assert found.row("clairvoyant", "mine").rmse == pytest.approx(same.rmse, rel=1e-12)
    assert found.row("clairvoyant", "published").rmse != pytest.approx(same.rmse, rel=1e-3)


def test_values_run_their_own_system_where_that_is_asked_for_too() -> None:
    both = compare(SCENARIO, {"mine": mine()}, 2, systems=("m-ekf", "told"), engine="torch")
    assert [row.system for row in both.rows] == ["m-ekf"]


def test_told_of_a_scenario_that_has_none_names_what_there_is() -> None:
    with pytest.raises(InputError, match=r"has none that is told .* expected one of"):
        compare(load_scenario("uwb-ranges"), systems=("told",))


def test_the_command_takes_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:  # fmt: skip
    place = tmp_path / "mine.json"
    save(mine(), place)
    words = ["compare", "airport-mlat-intermittent", "--system", "told", "--values", "published"]
    words += ["--values", str(place), "--trajectories", "2", "--engine", "torch"]
    assert main([*words, "--set", "world.steps=15", "--set", "worlds=[]"]) == 0
    shown = capsys.readouterr().out
    assert f"| clairvoyant | {place} |" in shown
    assert "told of every fault, to aim at, not to deploy, with published noise no bound" in shown
