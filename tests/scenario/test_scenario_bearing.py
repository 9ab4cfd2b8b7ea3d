"""Scenario keys of direction finding: angles, platform, known velocity, scored times, values."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
import torch
from helpers import assert_close, tensor

import difffilter as df
from difffilter.baselines import BearingLeastSquares
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.scenario.checkpoint import load, save
from difffilter.scenario.scenario import Scenario, load_scenario
from difffilter.scoring.metrics import Score, scored_rows
from difffilter.sensors.builtin import Bearing
from difffilter.sensors.stations import StationSensor

A, B, ABSOLUTE = "airport-mlat", "airborne-bearing", "airborne-bearing-absolute"
INPUTS = ("platform_x", "platform_y")
#: With another sensor, least squares still reads bearings alone, and so do the faults.
ALONE: dict[str, Any] = {
    f"systems.{name}.sensors": ["bearing"] for name in ("ls", "weighted-ls")
} | {f"faults.{name}.channels": ["bear*"] for name in ("burst", "at-130", "at-140", "at-160")}


def filter_of(scenario: Scenario, name: str) -> Filter:
    system = scenario.system(name)
    assert isinstance(system, Recipe)
    return system


def test_the_published_values_are_those_of_paper_1() -> None:
    gated = filter_of(load_scenario(B), "gated")
    declared = gated.declarations
    assert declared["bearing.sigma"].value == pytest.approx(math.radians(0.1), rel=1e-15)
    assert declared["bearing.sigma"].unit == "rad"
    assert declared["igg3.k"].value == (1.2, 4.0)
    assert declared["gate.threshold"].value == 7.879
    assert declared["start.sigma"].value == (1000.0, 1000.0, 0.0, 0.0)
    assert {name for name, parameter in declared.items() if parameter.tuned} == {
        "igg3.k", "gate.threshold", "motion.acceleration", "bearing.sigma", "start.sigma",
    }  # fmt: skip
    assert gated.sensors == (Bearing(sigma=math.radians(0.1)),)


@pytest.mark.parametrize(
    ("unit", "factor"), [("rad", 1.0), ("mrad", 1e-3), ("deg", math.pi / 180.0)]
)
def test_every_unit_of_angle_is_converted(unit: str, factor: float) -> None:
    keys = {"sensors.bearing.noise.unit": unit, "parameters.bearing.sigma.unit": unit}
    scenario = load_scenario(B, keys)
    assert scenario.sensors["bearing"].sigma == pytest.approx(0.1 * factor, rel=1e-15)
    declared = scenario.declarations()["bearing.sigma"]
    assert (declared.value, declared.unit) == (pytest.approx(0.1 * factor, rel=1e-15), "rad")
    fault = load_scenario(B, {"faults.burst.unit": unit}).faults["burst"]
    assert fault.scale == pytest.approx(factor, rel=1e-15)


def test_a_fault_in_sigmas_follows_the_worlds_noise_and_not_the_filters() -> None:
    keys = {"sensors.bearing.noise.sigma": 0.3, "parameters.bearing.sigma.value": 0.7}
    assert load_scenario(B, keys).faults["burst"].scale == pytest.approx(math.radians(0.3))


def test_a_fault_on_lengths_and_angles_together_is_refused() -> None:
    more = {"kind": "range", "stations": [[0.0, 0.0]], "noise": {"sigma": 5.0}}
    keys = ALONE | {"sensors.more": more, "parameters.more.sigma.value": 5.0}
    assert load_scenario(B, keys).channels == ("bearing", "more_1")
    keys["faults.burst.channels"] = ["*"]
    with pytest.raises(
        InputError, match=r"faults\.burst\.channels: found .*, expected channels of"
    ):
        load_scenario(B, keys)


def test_the_platforms_position_is_an_input_of_logs() -> None:
    scenario = load_scenario(ABSOLUTE)
    assert scenario.inputs == scenario.sensors["bearing"].platform == INPUTS
    assert load_scenario(ABSOLUTE, {"inputs": ["platform_y", "wind"]}).inputs == (
        "platform_y", "wind", "platform_x",
    )  # fmt: skip
    assert load_scenario(B).inputs == ()
    log = df.simulate(scenario, 2, seed=3)
    assert scenario.world is not None
    path = scenario.world.platform_path()
    for i, name in enumerate(INPUTS):
        assert torch.equal(log.inputs[name], path[:, i : i + 1].expand(200, 2))


@pytest.mark.parametrize("kind", ["range", "tdoa"])
def test_other_stations_ride_the_platform_too(kind: str) -> None:
    stations = [[0.0, 0.0], [50.0, 0.0], [0.0, 80.0]]
    sensor = {"kind": kind, "stations": stations, "platform": list(INPUTS)}
    keys = ALONE | {"sensors.more": sensor, "parameters.more.sigma.value": 1.0}
    scenario = load_scenario(ABSOLUTE, keys)
    log = df.simulate(scenario, 2, seed=3)
    assert log.truth is not None
    model = scenario.sensors["more"].model
    assert isinstance(model, StationSensor)
    constants = filter_of(scenario, "ekf").prepare()
    exact = model.predict(log.truth, log.inputs, constants)
    apart = log.truth[..., :2] - torch.stack([log.inputs[name] for name in INPUTS], dim=-1)
    distance = (apart.unsqueeze(-2) - tensor(stations)).norm(dim=-1)
    expected = distance if kind == "range" else distance[..., 1:] - distance[..., :1]
    assert_close(exact, expected, 1e-12)
    assert float((log.z[..., 1:] - expected).abs().max()) < 6.0


def test_a_recorded_scenario_names_the_columns_of_its_platform(tmp_path: Path) -> None:
    """Without [world] any names will do."""
    path = tmp_path / "mine.toml"
    path.write_text(
        'schema = 1\nname = "mine"\ntitle = "t"\naxes = 2\n'
        '[sensors.df]\nkind = "bearing"\nplatform = ["east", "north"]\n'
        '[start]\nkind = "bearings"\nvelocity = [0.0, 0.0]\nrows = 4\n'
        "[parameters.motion.acceleration]\nvalue = 0.1\n"
        '[parameters.df.sigma]\nvalue = 1.0\nunit = "deg"\n'
        "[parameters.start.sigma]\nvalue = [100.0, 100.0, 0.0, 0.0]\n[systems.ekf]\n"
    )
    scenario = load_scenario(path)
    assert scenario.inputs == ("east", "north")
    lines = ["time,df,east,north"]
    for k in range(12):
        east, north = 100.0 * k, 5.0 * k * k
        lines.append(f"{k},{math.atan2(4000.0 - north, 300.0 - east)!r},{east},{north}")
    (tmp_path / "log.csv").write_text("\n".join(lines) + "\n")
    log = df.load_logs(scenario, [tmp_path / "log.csv"])
    system = scenario.system("ekf")
    ready = df.started(scenario, system, log)
    assert ready.start is not None
    assert ready.start.time is None
    expected = tensor([300.0, 4000.0, 0.0, 0.0])
    assert_close(ready.start.mean.reshape(-1), expected, 1e-9)
    assert_close(df.estimate(system, ready).mean[-1].reshape(-1), expected, 1e-6)


def test_a_start_by_bearings_is_one_step_before_a_simulated_worlds_first_row() -> None:
    scenario = load_scenario(B, {"world.dt": 0.5})
    system = scenario.system("ekf")
    log = df.simulate(scenario, 2, seed=3)
    assert log.start is None
    start = df.started(scenario, system, log).start
    assert start is not None
    assert start.time == 0.0
    again = df.started(scenario, system, df.started(scenario, system, log)).start
    assert again is not None
    assert torch.equal(again.mean, start.mean)


def test_without_score_times_every_row_counts() -> None:
    assert load_scenario(A).score == Score("all", -math.inf, math.inf)


@pytest.mark.parametrize(("times", "count"), [([50.0, 200.0], 151), ([3.0, 3.0], 1)])
def test_only_rows_between_the_score_times_count(times: list[float], count: int) -> None:
    scenario = load_scenario(B, {"score_times": times})
    log = df.simulate(scenario, 3, seed=3)
    system = scenario.system("ekf")
    track = df.estimate(system, df.started(scenario, system, log))
    rows = scored_rows(log, track, scenario.score)
    assert rows.sum() == 3 * count
    table = df.compare(scenario, trajectories=3, seed=3)
    held = df.simulate(scenario, 3, 3, "test")
    again = df.estimate(system, df.started(scenario, system, held))
    expected = float(df.rmse(held, again, scenario.score))
    assert table.row("ekf").rmse == pytest.approx(expected, rel=1e-9)


def test_a_systems_own_values_stand_before_the_scenarios() -> None:
    values = {"tdoa.sigma": 7.0, "motion.acceleration": [1.0, 2.0]}
    keys: dict[str, Any] = {"systems.ekf.values": values}
    scenario = load_scenario(A, keys)
    own, other = filter_of(scenario, "ekf").declarations, filter_of(scenario, "huber").declarations
    assert own["tdoa.sigma"].value == 7.0
    assert own["motion.acceleration"].value == (1.0, 2.0)
    assert own["tdoa.sigma"].tuned
    assert other == filter_of(load_scenario(A), "huber").declarations
    multipath = load_scenario("airborne-bearing-multipath")
    told = filter_of(multipath, "clairvoyant").declarations
    assert told["motion.acceleration"].value == 0.02
    assert filter_of(multipath, "ekf").declarations["motion.acceleration"].value == 0.1


def test_a_systems_own_value_need_not_be_among_the_scenarios() -> None:
    scenario = load_scenario(A, {"systems.ekf.values": {"tdoa.bias": 2.0}})
    own = filter_of(scenario, "ekf").declarations["tdoa.bias"]
    assert own.value == 2.0
    log = df.simulate(scenario, 2, seed=1)
    plain = filter_of(load_scenario(A), "ekf")
    expected = df.run(plain, log, {"tdoa.bias": tensor(2.0)})
    assert_close(df.run(filter_of(scenario, "ekf"), log).mean, expected.mean, 1e-12)


GROUPS = {"near": ["tdoa_2", "tdoa_4"], "far": ["tdoa_5"]}
SCOPES: dict[str, tuple[Any, Any]] = {
    "channel": ("channel", None),
    "sensor": ("sensor", (tuple(range(7)),)),
    "all": ("all", (tuple(range(7)),)),
    "named": (GROUPS, ((0, 2), (3,), (1,), (4,), (5,), (6,))),
}


@pytest.mark.parametrize("name", SCOPES)
def test_a_scope_is_a_word_or_a_table_of_channels(name: str) -> None:
    scope, expected = SCOPES[name]
    scenario = load_scenario(A, {"systems.ekf.scope": scope, "systems.ekf.gate": "reject"})
    assert filter_of(scenario, "ekf").grouped == expected


RECIPES: dict[str, dict[str, Any]] = {
    "groups": {"scope": GROUPS, "distance": "mahalanobis", "gate": "reject"},
    "values": {"values": {"tdoa.sigma": 7.0, "motion.acceleration": [1.0, 2.0]}},
    "recovery": {"gate": "reject", "recovery": "widen"},
}


@pytest.mark.parametrize("name", RECIPES)
def test_a_recipe_with_tables_is_saved_and_loaded(tmp_path: Path, name: str) -> None:
    keys = {f"systems.ekf.{key}": value for key, value in RECIPES[name].items()}
    scenario = load_scenario(A, keys)
    filter = filter_of(scenario, "ekf")
    save(df.Checkpoint(scenario, "ekf", filter.published()), tmp_path / "x.json")
    assert load(tmp_path / "x.json").published_filter == filter


def test_parameters_of_recovery_are_declared_by_the_scenario() -> None:
    keys = {
        "systems.ekf.gate": "reject",
        "systems.ekf.recovery": "widen",
        "parameters.recovery.rejections.value": 2.5,
        "parameters.recovery.factor": {"value": 9.0, "tuned": True},
    }
    scenario = load_scenario(A, keys)
    own = filter_of(scenario, "ekf").declarations
    assert own["recovery.rejections"].value == 2.5
    assert (own["recovery.factor"].value, own["recovery.factor"].tuned) == (9.0, True)
    assert "recovery.factor" not in filter_of(scenario, "m-ekf").declarations


@pytest.mark.parametrize(("estimator", "weighted"), [("bearing-ls", False), ("bearing-wls", True)])
def test_least_squares_takes_the_velocity_of_the_start(estimator: str, weighted: bool) -> None:
    keys = {"systems.own": {"estimator": estimator}, "start.velocity": [-590.0, 3.0]}
    system = load_scenario(B, keys).system("own")
    assert isinstance(system, BearingLeastSquares)
    assert (system.velocity, system.weighted) == ((-590.0, 3.0), weighted)
    with pytest.raises(
        InputError, match=r"systems\.own: estimator: found no velocity in \[start\]"
    ):
        load_scenario(
            B,
            {
                "systems": {"own": {"estimator": estimator}},
                "start": {"kind": "measurements"},
                "tuning.system": "own",
            },
        )


def test_a_known_state_stays_known_in_tuning() -> None:
    scenario = load_scenario(B, {"world.steps": 15, "score_times": [1.0, 15.0]})
    settings = {"steps": 2, "trajectories": 8, "validation": 8, "test": 8, "batch": 8}
    tuned = df.tune(scenario, seed=1, settings=settings).checkpoint
    sigma = tuned.values["start.sigma"]
    assert sigma[2:].tolist() == [0.0, 0.0]
    assert not torch.equal(sigma[:2], tensor([1000.0, 1000.0]))


def test_a_direction_finding_log_tunes_in_windows() -> None:
    """Its first window begins with a velocity that is known exactly."""
    keys = {"world.steps": 60, "score_times": [1.0, 60.0]}
    scenario = load_scenario(ABSOLUTE, keys)
    log = df.simulate(scenario, 2, seed=1)
    settings = {"steps": 2, "window": 20, "batch": 3}
    tuned = df.tune(scenario, log, settings=settings).checkpoint
    assert tuned.values["start.sigma"][2:].tolist() == [0.0, 0.0]
    assert set(tuned.values) == set(filter_of(scenario, "gated").declarations)
