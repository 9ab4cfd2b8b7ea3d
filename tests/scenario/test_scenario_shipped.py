"""Scenario files that ship, and the user's own: inheritance, overrides, units, runs."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from helpers import array, assert_close, tensor
from oracles import airport

import difffilter
from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.scenario.document import apply_overrides, parse_override, read_document
from difffilter.scenario.recorded import scenario_of_run
from difffilter.scenario.scenario import load_scenario

BEARING_SYSTEMS = "ls weighted-ls ekf robust robust-noise gated clairvoyant"
MANOEUVRE_SYSTEMS = (
    "srckf robust-srckf lcasrckf stf-srckf rmckf fusion "
    "pooled-lcasrckf pooled-stf-srckf pooled-robust imm imm-turns imm-turns-gated"
)
SYSTEMS = {
    "airport-mlat": "taylor-ls chan-ls ekf chan-ekf adaptive-ekf huber m-ekf m-ekf-all-rows "
    "m-ekf-mad clairvoyant",
    "airport-mlat-intermittent": "taylor-ls chan-ls ekf chan-ekf adaptive-ekf huber m-ekf "
    "m-ekf-all-rows m-ekf-mad clairvoyant",
    "uwb-ranges": "ekf robust",
    "uwb-simulated": "ekf robust clairvoyant",
    "airborne-bearing": BEARING_SYSTEMS,
    "airborne-bearing-absolute": BEARING_SYSTEMS,
    "airborne-bearing-clean": BEARING_SYSTEMS,
    "airborne-bearing-matched": BEARING_SYSTEMS,
    "airborne-bearing-multipath": BEARING_SYSTEMS,
    "gate-lockout": "ekf gated gated-widen gated-inflate clairvoyant",
    "manoeuvre-fusion-1": MANOEUVRE_SYSTEMS,
    "manoeuvre-fusion-2": MANOEUVRE_SYSTEMS,
    "urban-credibility": "standard credibility ideal",
    "urban-credibility-2d": "standard credibility ideal",
    "urban-credibility-faulty": "standard credibility ideal good good-standard clairvoyant",
}
NS = 0.299792458


@pytest.mark.parametrize("name", difffilter.scenario_names())
def test_every_shipped_scenario_loads_and_every_system_builds(name: str) -> None:
    scenario = load_scenario(name)
    assert scenario.name == name
    assert scenario.title
    assert scenario.notes
    for system, spec in scenario.systems.items():
        parts = [scenario.sensors[sensor].model.channels for sensor in spec.sensors]
        assert scenario.system(system).channels == tuple(c for part in parts for c in part)
    tuned = scenario.system()
    assert isinstance(tuned, Recipe)
    assert any(parameter.tuned for parameter in tuned.declarations.values())
    assert all(p.source for n, p in scenario.declarations().items() if n in scenario.parameters)


def test_the_list_of_shipped_scenarios_is_complete() -> None:
    assert sorted(SYSTEMS) == sorted(difffilter.scenario_names())


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_systems_of_the_papers_are_there_by_name(name: str) -> None:
    assert list(load_scenario(name).systems) == SYSTEMS[name].split()


def test_the_airport_is_the_calibrated_one() -> None:
    scenario = load_scenario("airport-mlat")
    tdoa, world = scenario.sensors["tdoa"], scenario.world
    assert world is not None
    assert (world.dt, world.steps) == (airport.STEP, 100)
    assert_close(tensor((*world.position, *world.velocity)), airport.START, 1e-15)
    assert scenario.channels == tuple(f"tdoa_{i}" for i in range(2, 9))
    assert tdoa.sigma == pytest.approx(airport.metres(10.0), rel=1e-15)
    truth = torch.tensor([[300.0, 900.0, 0.0, 0.0]], dtype=torch.float64)
    constants = tdoa.model.prepare({p.name: p.tensor() for p in tdoa.model.parameters})
    exact = tdoa.model.predict(truth, {}, constants)
    assert_close(exact, airport.range_differences(array(truth)), 1e-14)
    declared = scenario.declarations()
    assert declared["tanh.ab"].value == (1.5, 4.0)
    assert declared["start.sigma"].value == (5.0, 5.0, 2.0, 2.0)
    assert {n for n, p in declared.items() if p.tuned} == {
        "motion.acceleration", "tdoa.sigma", "tdoa.bias", "tanh.ab", "prior.floor",
    }  # fmt: skip


def test_nanoseconds_are_metres_of_light() -> None:
    scenario = load_scenario("airport-mlat-intermittent")
    fault = scenario.faults["nlos"]
    assert fault.scale == pytest.approx(100.0 * NS, rel=1e-15)
    assert fault.probability == 0.1
    declared = scenario.declarations()["tdoa.sigma"]
    assert (declared.value, declared.unit) == (pytest.approx(10.0 * NS, rel=1e-15), "m")


@pytest.mark.parametrize(
    ("unit", "factor"),
    [("m", 1.0), ("km", 1e3), ("cm", 1e-2), ("us", 1e3 * NS), ("ns", NS)],
)
def test_every_unit_of_length_is_converted(unit: str, factor: float) -> None:
    keys = ("sensors.tdoa.noise", "faults.nlos", "parameters.tdoa.sigma")
    scenario = load_scenario("airport-mlat", {f"{key}.unit": unit for key in keys})
    assert scenario.sensors["tdoa"].sigma == pytest.approx(10.0 * factor, rel=1e-15)
    assert scenario.faults["nlos"].scale == pytest.approx(5.0 * factor, rel=1e-15)
    assert scenario.declarations()["tdoa.sigma"].value == pytest.approx(10.0 * factor, rel=1e-15)


@pytest.mark.parametrize("unit", ["deg", "rad", "m/s^2", "s"])
def test_a_unit_of_something_else_is_refused(unit: str) -> None:
    with pytest.raises(InputError, match=r"parameters\.tdoa\.sigma\.unit: found .*expected 'm'"):
        load_scenario("airport-mlat", {"parameters.tdoa.sigma.unit": unit})


CHILD = """\
schema = 1
extends = "airport-mlat-intermittent"
name = "child"
title = "mine"
[faults.nlos]
probability = 0.3
[parameters.tanh.ab]
value = [1.0, 3.0]
"""


def test_a_users_file_extends_a_shipped_one_key_by_key(tmp_path: Path) -> None:
    path = tmp_path / "child.toml"
    path.write_text(CHILD)
    child, parent = load_scenario(path), load_scenario("airport-mlat-intermittent")
    assert (child.name, child.path) == ("child", path)
    assert child.faults["nlos"].probability == 0.3
    assert child.faults["nlos"].scale == parent.faults["nlos"].scale
    assert child.declarations()["tanh.ab"].value == (1.0, 3.0)
    assert child.declarations()["tanh.ab"].tuned
    assert list(child.systems) == list(parent.systems)
    assert child.notes == parent.notes
    assert "extends" not in child.document


def test_a_file_extends_another_beside_it(tmp_path: Path) -> None:
    (tmp_path / "child.toml").write_text(CHILD)
    (tmp_path / "grand.toml").write_text(
        'schema = 1\nextends = "child.toml"\n[faults.nlos]\nscale = 7.0\n'
    )
    grand = load_scenario(tmp_path / "grand.toml")
    assert grand.faults["nlos"].probability == 0.3
    assert grand.faults["nlos"].scale == pytest.approx(7.0 * NS)


@pytest.mark.parametrize("chain", [("a",), ("a", "b"), ("a", "b", "c")])
def test_a_circle_of_files_is_refused(tmp_path: Path, chain: tuple[str, ...]) -> None:
    for name, parent in zip(chain, (*chain[1:], chain[0]), strict=True):
        (tmp_path / f"{name}.toml").write_text(f'schema = 1\nextends = "{parent}.toml"\n')
    with pytest.raises(InputError, match=r"a\.toml: extends: found a circle"):
        load_scenario(tmp_path / "a.toml")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("schema = 2", r"mine\.toml: schema: found 2, expected 1"),
        ("name = 'x'", r"mine\.toml: schema: found None, expected 1"),
        ("schema = 1\nextends = 'airport-mlatt'", "found 'airport-mlatt'.*did you mean airport-ml"),
        ("schema = 1\nextends = 'none.toml'", r"none\.toml: found no such file"),
        ("schema = 1\nextends = 3", r"mine\.toml: extends: found 3, expected a name or a path"),
        ("schema = = 1", r"mine\.toml: not valid TOML: .*line 1"),
        ("schema = 1\nschema = 1", r"mine\.toml: not valid TOML"),
        ("schema = 1\n\xff", r"mine\.toml: cannot be read"),
    ],
)
def test_a_file_that_cannot_be_used_is_named(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "mine.toml"
    path.write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=message):
        load_scenario(path)


@pytest.mark.parametrize(
    ("text", "path", "value"),
    [
        ("world.steps=7", "world.steps", 7),
        ("world.dt = 0.5", "world.dt", 0.5),
        ("systems.huber.mad=true", "systems.huber.mad", True),
        ("name=run one", "name", "run one"),
        ('name="7"', "name", "7"),
        ("world.position=[1.0, 2]", "world.position", [1.0, 2]),
        ("a=b=c", "a", "b=c"),
        ("a=", "a", ""),
    ],
)
def test_an_override_is_read_as_toml_or_as_text(text: str, path: str, value: object) -> None:
    assert parse_override(text) == (path, value)


@pytest.mark.parametrize("text", ["world.steps", "=3", "", " = 1"])
def test_an_override_without_key_or_value_is_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"expected key\.path=value"):
        parse_override(text)


def test_overrides_reach_into_lists_and_leave_the_document_alone() -> None:
    document, _ = read_document("airport-mlat")
    keys = {"sensors.tdoa.stations.3.1": 1250.0, "sensors.tdoa.stations.4": [1.0, 2.0]}
    changed = apply_overrides(document, keys)
    stations = changed["sensors"]["tdoa"]["stations"]
    assert stations[3] == [1600.0, 1250.0]
    assert stations[4] == [1.0, 2.0]
    assert document["sensors"]["tdoa"]["stations"][3] == [1600.0, 1200.0]
    scenario = load_scenario("airport-mlat", keys)
    assert scenario.sensors["tdoa"].model.stations[3] == (1600.0, 1250.0)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("path", "message"),
    [
        ("sensors.tdoa.stations.8", "stations.8: found index '8', expected 0 to 7"),
        ("sensors.tdoa.stations.-1", "found index '-1'"),
        ("sensors.tdoa.stations.first", "found index 'first', expected 0 to 7"),
        ("sensors.tdoa.stations.\N{SUPERSCRIPT TWO}", "found index"),
        ("sensors.tdoa.stations.0.0.0", "found a value at its parent, expected a table"),
        ("world.dt.x.y", "world.dt.x: found a value at its parent, expected a table"),
    ],
)
def test_an_override_that_leads_nowhere_is_refused(path: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_scenario("airport-mlat", {path: 1.0})


def test_with_overrides_leaves_the_scenario_itself_alone() -> None:
    scenario = load_scenario("airport-mlat")
    other = scenario.with_overrides({"world.steps": 5})
    assert scenario.world is not None
    assert other.world is not None
    assert (scenario.world.steps, other.world.steps) == (100, 5)


def test_a_run_has_its_own_geometry() -> None:
    scenario = load_scenario("uwb-ranges")
    own = scenario_of_run(scenario, "nlos_A2")
    expected = scenario.runs["nlos_A2"]["sensors.range.stations"]
    assert [list(s) for s in own.sensors["range"].model.stations] == expected  # type: ignore[attr-defined]
    assert own.sensors["range"].model != scenario.sensors["range"].model
    assert scenario_of_run(scenario, "another") is scenario


def test_only_scenarios_with_references_carry_them() -> None:
    references = load_scenario("uwb-ranges").references
    assert {r.run for r in references} == set(load_scenario("uwb-ranges").runs)
    assert all(r.source and r.rmse > 0 for r in references)
    assert load_scenario("airport-mlat").references == ()
