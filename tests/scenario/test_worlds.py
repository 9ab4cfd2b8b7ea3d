"""Families: the worlds that a scenario's values must serve, read, checked and simulated."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from difffilter import Family, Log, Member, family, load_scenario, simulate
from difffilter.errors import InputError
from difffilter.scenario.estimation import estimate
from difffilter.scenario.worlds import scenario_of_world

QUIET = {"name": "quiet", "overrides": {"faults.nlos.probability": 0.0}}
MOVED = [[0.0, 0.0], [1500.0, 0.0], [0.0, 1200.0], [1600.0, 1200.0],
         [0.0, 2400.0], [1600.0, 2400.0], [0.0, 3500.0], [1600.0, 3500.0]]  # fmt: skip


def airport(*worlds: dict[str, Any], **more: Any) -> Any:
    keys = {"world.steps": 12, "worlds": list(worlds), **more}
    return load_scenario("airport-mlat-intermittent", keys)


def test_a_family_begins_with_the_scenarios_own_world_as_it_always_was() -> None:
    scenario = airport(QUIET)
    found = family(scenario)
    assert [(m.name, m.role, m.allow, m.weight) for m in found] == [
        ("base", "tune", 1.02, 1.0),
        ("quiet", "guard", 1.02, 1.0),
    ]
    base, own = found["base"].log(3, 7, "test"), simulate(scenario, 3, 7, "test")
    assert torch.equal(base.z, own.z)
    quiet = found["quiet"].log(3, 7, "test")
    assert not quiet.inputs["fault.mean"].any()
    assert not torch.equal(quiet.truth, own.truth)  # draws of its own
    assert torch.equal(quiet.z, found["quiet"].log(3, 7, "test").z)


def test_a_world_changes_the_truth_and_no_filter() -> None:
    change = {"sensors.tdoa.noise.sigma": 50.0, "world.steps": 5}
    scenario = airport({"name": "noisy", "overrides": change})
    other = scenario_of_world(scenario, "noisy")
    assert other.world.steps == 5
    assert other.sensors["tdoa"].sigma == pytest.approx(50 * 0.299792458)
    ours, theirs = scenario.system("m-ekf"), other.system("m-ekf")
    for name, value in ours.published().items():
        assert torch.equal(value, theirs.published()[name]), name
    assert scenario_of_world(scenario, "base") is scenario


def test_one_filter_is_told_where_the_stations_of_each_world_stand() -> None:
    scenario = airport({"name": "moved", "overrides": {"sensors.tdoa.stations": MOVED}})
    filter = scenario.system("ekf")
    for member in family(scenario):
        log = member.log(20, 3, "test")
        assert log.inputs["tdoa.stations"].shape == (12, 20, 8, 2)
        own = scenario_of_world(scenario, member.name)
        ready = member.starter(filter, log, None)
        told = estimate(filter, ready, engine="torch")
        built = own.system("ekf")
        without = replace(ready, inputs={})
        assert torch.allclose(told.mean, estimate(built, without, engine="torch").mean)


def test_recorded_logs_and_groups_of_them_are_a_family() -> None:
    scenario = load_scenario(
        "uwb-ranges",
        {
            "worlds": [
                {"name": "base", "weight": 2.0},
                {"name": "hidden", "logs": ["nlos_*"], "role": "tune"},
                {"name": "none", "logs": ["rain"]},
            ]
        },
    )
    names = ("los_A1", "nlos_A1", "nlos_A2")
    z = torch.arange(2 * 3 * 4, dtype=torch.float64).reshape(2, 3, 4)
    log = Log(scenario.channels, torch.arange(2.0, dtype=torch.float64), z, names=names)
    found = family(scenario, log)
    assert [(m.name, m.weight, m.recorded) for m in found] == [
        ("base", 2.0, True),
        ("hidden", 1.0, True),
    ]
    assert found["base"].log(100) is log
    assert found["hidden"].log(100).names == names[1:]
    assert torch.equal(found["hidden"].log(1).z, z[:, 1:])
    with pytest.raises(InputError, match=r"uwb-ranges: has no \[world\]"):
        family(scenario)


WRONG = [
    ([{"overrides": {"world.steps": 3}}], r"worlds\[0\]\.name: found nothing, expected a text"),
    ([QUIET, QUIET], r"worlds\[1\]\.name: found 'quiet', expected no name twice"),
    ([{**QUIET, "name": "../x"}], r"worlds\[0\]\.name: found '\.\./x', expected a name"),
    ([{**QUIET, "role": "base"}], r"role: found 'base', expected one of tune, guard"),
    ([{**QUIET, "allow": 0.9}], r"allow: found 0\.9, expected a number of 1 or more"),
    ([{**QUIET, "weight": 0}], r"weight: found 0, expected a number above 0"),
    ([{"name": "a"}], r"overrides: found nothing, expected overrides or times"),
    ([{"name": "a", "times": {"world.dtt": 2.0}}], r"times\.world\.dtt: found None, expected numb"),
    ([{"name": "a", "times": {"faults.nlos.kind": 2.0}}], r"found 'offset', expected numbers"),
    ([{"name": "a", "times": {"faults.nlos.probability": -1.0}}], r"probability: found -0.1, exp"),
    ([{"name": "a", "times": {"world.dt": "2"}}], r"world\.dt: found '2', expected a number"),
    ([{**QUIET, "logs": ["a"]}], r"overrides: found \{.*\}, expected overrides or times"),
    ([{**QUIET, "name": "base"}], r"name: found 'base', expected no overrides, times or logs"),
    (
        [{"name": "base", "role": "guard"}, {**QUIET, "rule": 1}],
        r"unknown key, did you mean 'role'",
    ),
    ([{"name": "a", "overrides": {"systems.ekf.weight": "huber"}}], "expected a quoted dotted key"),
    ([{"name": "a", "overrides": {"world": {"steps": 3}}}], "expected a quoted dotted key"),
    ([{"name": "a", "overrides": {"sensors.tdoa.kind": "range"}}], "expected a quoted dotted key"),
    ([{"name": "a", "overrides": {"world.stepz": 3}}], r"worlds\[0\]: .*world\.stepz: unknown key"),
    ([{"name": "a", "overrides": {"world.axes": 3}}], r"worlds\[0\]: "),
    ([{"name": "a", "overrides": {"sensors.tdoa.stations": MOVED[:4]}}], r"worlds\[0\]: "),
]


@pytest.mark.parametrize(("worlds", "message"), WRONG)
def test_what_is_wrong_with_an_entry_is_said(worlds: list[dict[str, Any]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        airport(*worlds)


def test_a_recorded_scenario_has_no_world_to_change() -> None:
    with pytest.raises(InputError, match="expected logs in place of them"):
        load_scenario("uwb-ranges", {"worlds": [QUIET]})


def test_a_family_of_ones_own_logs_is_checked_alike() -> None:
    log = Log(("x",), torch.arange(2.0), torch.zeros(2, 1))
    for wrong in ({"name": "a b"}, {"weight": 0.0}, {"role": "x"}, {"allow": 0.5}):
        with pytest.raises(InputError, match="world"):
            Member(**{"name": "a", "source": log} | wrong)
    one = Member("a", log)
    for members, message in (
        ((), "found none"),
        ((one, one), "found a twice"),
        ((replace(one, role="guard"),), "found guards alone"),
    ):
        with pytest.raises(InputError, match=message):
            Family(members)
    with pytest.raises(InputError, match="found 'b', expected one of a"):
        Family((one,))["b"]


@pytest.mark.parametrize("scale", [5.0, 50.0])
def test_times_multiplies_what_the_scenario_says_and_follows_it(scale: float) -> None:
    times = {"faults.nlos.scale": 2.0, "world.acceleration.high": 0.5}
    scenario = airport({"name": "twice", "times": times}, **{"faults.nlos.scale": scale})
    other = scenario_of_world(scenario, "twice")
    assert other.faults["nlos"].scale == pytest.approx(2 * scenario.faults["nlos"].scale)
    assert other.world.acceleration.second == (0.0, 5.0)


def test_no_fault_is_more_frequent_than_always() -> None:
    always = {"name": "always", "times": {"faults.nlos.probability": 20.0}}
    assert scenario_of_world(airport(always), "always").faults["nlos"].probability == 1.0
