"""Names of one's own in scenario files: weights, adaptations, baselines; each registered once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pytest
import torch

from difffilter import (
    ADAPTATIONS,
    BASELINES,
    WEIGHTS,
    Checkpoint,
    adapter,
    baseline,
    load,
    save,
    weight,
)
from difffilter.adaptation.passive import Passive
from difffilter.baselines import ChanLeastSquares
from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.scenario.options import OPTIONS
from difffilter.scenario.scenario import load_scenario
from difffilter.scenario.systems import recipes

TABLES = (WEIGHTS, ADAPTATIONS, BASELINES)


@pytest.fixture(autouse=True)
def _only_built_in() -> Iterator[None]:
    known = [set(table) for table in TABLES]
    yield
    for table, names in zip(TABLES, known, strict=True):
        for name in set(table) - names:
            table.remove(name)


def test_a_weight_of_ones_own_works_like_a_built_in_one(tmp_path) -> None:
    half = weight("half")(lambda s, constants, temperature: 1.0 / (1.0 + s.abs()))
    scenario = load_scenario("airport-mlat", {"systems.mine": {"weight": "half"}})
    system = scenario.system("mine")
    assert isinstance(system, Recipe)
    assert system.weight is half
    assert "weight half" in recipes(scenario.document["systems"])["mine"]
    save(Checkpoint(scenario, "mine", system.published()), tmp_path / "mine.json")
    assert load(tmp_path / "mine.json").filter.weight is half
    WEIGHTS.remove("half")
    with pytest.raises(InputError, match=r"systems\.mine\.weight: found 'half', expected one of"):
        load(tmp_path / "mine.json")


def test_an_adaptation_is_a_class_or_a_function_of_its_filter() -> None:
    @adapter("nothing")
    class Nothing(Passive):
        pass

    @dataclass(frozen=True)
    class Told(Passive):
        seen: tuple[object, ...] = ()

    adapter("told")(lambda host: Told((host.weight.name, host.systems, host.axes)))
    keys = {"weight": "huber", "adaptation": ["nothing", "told"]}
    scenario = load_scenario("uwb-simulated", {"systems.mine": keys})
    system = scenario.system("mine")
    assert isinstance(system, Recipe)
    nothing, told = system.adaptation.parts  # type: ignore[union-attr]
    assert isinstance(nothing, Nothing)
    members = tuple(tuple(group) for group in system.members)
    assert told.seen == ("huber", members, 2)


def test_a_baseline_is_given_what_it_asks_for() -> None:
    asked = []

    @baseline("mine")
    def mine(given):  # type: ignore[no-untyped-def]
        asked.append((given.axes, given.motion.parameters[0].value))
        with pytest.raises(InputError, match=r"found no velocity in \[start\]"):
            _ = given.velocity
        return ChanLeastSquares(given.sensors, given.axes)

    scenario = load_scenario("airport-mlat", {"systems.own": {"estimator": "mine"}})
    assert isinstance(scenario.system("own"), ChanLeastSquares)
    published = scenario.parameters["motion.acceleration"].value
    assert set(asked) == {(scenario.axes, published)}


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.kind)
def test_a_name_is_registered_once_and_is_a_name(table) -> None:
    taken = next(iter(table))
    with pytest.raises(InputError, match=f"{table.kind} {taken}: registered already"):
        table.add(taken, object())
    for name in ("", "9", "a b", "../evil", "a" * 65, "a\n", "*/ evil"):
        with pytest.raises(InputError, match="found name"):
            table.add(name, object())
    with pytest.raises(InputError, match=f"{table.kind}: found 'x', expected one of {taken}"):
        table["x"]
    with pytest.raises(InputError, match="found 'x'"):
        table.remove("x")


def test_every_option_of_a_filter_is_an_argument_of_it() -> None:
    system = load_scenario("airport-mlat").system("ekf")
    for key, option in OPTIONS.items():
        assert hasattr(system, key) == (key != "fusion"), key  # that one makes another recipe
        assert callable(option.make)
    assert torch.is_tensor(system.published()["motion.acceleration"])
