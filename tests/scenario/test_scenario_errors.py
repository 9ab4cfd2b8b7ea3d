"""Whatever is wrong in a scenario is named: file, dotted key, what was found and expected."""

from __future__ import annotations

import copy
import math
import re
from typing import Any

import pytest

from difffilter.errors import InputError
from difffilter.scenario.document import read_document
from difffilter.scenario.scenario import load_scenario, read_scenario

A, U = "airport-mlat", "uwb-ranges"
B, ABSOLUTE = "airborne-bearing", "airborne-bearing-absolute"
MANOEUVRE = "manoeuvre-fusion-1"
URBAN, URBAN_2D = "urban-credibility", "urban-credibility-2d"
TEXT, LIST, TABLE, FLAG = "north", [1.0], {"a": 1.0}, True
HUGE = 10**400

#: Dotted key, a wrong value, and what the message expects.
WRONG: list[tuple[str, Any, str]] = [
    ("name", 5, "a text"),
    ("title", FLAG, "a text"),
    ("notes", "one", "a list of texts"),
    ("score", "some", "one of all, measured"),
    ("score_times", [1.0], "a list of 2 numbers"),
    ("score_times", 5.0, "a list of 2 numbers"),
    ("score_times", [0.0, math.inf], "a list of 2 numbers"),
    ("score_times", [math.nan, 5.0], "a list of 2 numbers"),
    ("score_times", [5.0, 4.0], "[first, last] with first <= last"),
    ("inputs", [1], "a list of texts"),
    ("schema", 1.0, "a whole number"),
    ("world", 3, "a table"),
    ("world.axes", 4, "a whole number from 1 to 3"),
    ("world.axes", 0, "a whole number of 1 or more"),
    ("world.dt", 0.0, "a number above 0"),
    ("world.dt", math.nan, "a number above 0"),
    ("world.dt", TEXT, "a number above 0"),
    ("world.dt", FLAG, "a number above 0"),
    ("world.dt", HUGE, "a number above 0"),
    ("world.steps", 10.0, "a whole number of 1 or more"),
    ("world.steps", 0, "a whole number of 1 or more"),
    ("world.position", [1.0], "a list of 2 numbers"),
    ("world.position", [1.0, math.inf], "a list of 2 numbers"),
    ("world.velocity", [1.0, TEXT], "a list of 2 numbers"),
    ("world.velocity", 3.0, "a list of 2 numbers"),
    ("world.disturbance", [0.0, 0.0], "a list of 4 numbers"),
    ("world.disturbance", [0.0, 0.0, -1.0, 0.0], "standard deviations of 0 or more"),
    ("world.segments", TABLE, "an array of tables"),
    ("world.jumps", [1], "an array of tables"),
    ("world.acceleration.distribution", "gauss", "one of constant, uniform, normal"),
    ("world.acceleration.low", [0.0, 0.0, 0.0], "a number or a list of 2 numbers"),
    ("world.acceleration.high", [0.0, -20.0], "numbers not below low"),
    ("world.acceleration.two_sided", 1, "true or false"),
    ("sensors.tdoa", LIST, "a table"),
    ("sensors", {}, "one sensor or more"),
    ("sensors.tdoa.kind", "radar", "one of tdoa, range, bearing, position"),
    ("sensors.tdoa.stations", [[0.0, 0.0], [1.0]], "a number, a list of numbers or a matrix"),
    ("sensors.tdoa.stations", [[0.0, 0.0]], "two or more, the reference"),
    (
        "sensors.tdoa.stations",
        [[0.0], [1.0], [2.0]],
        "2, or 3 with the height",
    ),
    ("sensors.tdoa.stations", [0.0, 1.0], "a list of points"),
    ("sensors.tdoa.stations", [[[0.0]], [[1.0]]], "a list of points"),
    ("sensors.tdoa.channels", ["a", "b"], "7"),
    ("sensors.tdoa.channels", "a", "a list of texts"),
    ("sensors.tdoa.height", None, "a number"),
    ("sensors.tdoa.platform", "platform_x", "a list of texts"),
    ("sensors.tdoa.platform", ["a"], "2, one per coordinate"),
    ("sensors.tdoa.platform", ["a", "b"], "the inputs of [world.platform]: none without [wo"),
    (
        "sensors.b",
        {"kind": "bearing", "stations": [[0.0] * 3]},
        "2, for every station",
    ),
    ("sensors.b", {"kind": "bearing", "channels": ["a", "b"]}, "1"),
    ("sensors.b", {"kind": "bearing", "noise": {"unit": "m"}}, "one of rad, mrad, deg"),
    ("world.platform", 3, "a table"),
    ("world.platform", {"position": [0.0, 0.0]}, "a list of 2 numbers"),
    ("sensors.tdoa.noise.sigma", -1.0, "a number above 0"),
    ("sensors.tdoa.noise.unit", "feet", "one of m, km, cm, us, ns"),
    ("sensors.tdoa.noise.common_sigma", -0.1, "a number of 0 or more"),
    ("sensors.p", {"kind": "position", "channels": ["a"]}, "2"),
    ("faults.nlos.kind", "jam", "one of offset, zero, dropout"),
    ("faults.nlos.channels", ["range_*"], "patterns that match some of tdoa_2"),
    ("faults.nlos.channels", [], "one pattern or more"),
    ("faults.nlos.probability", 1.5, "a number of 0 or more and at most 1"),
    ("faults.nlos.duration", 0, "a whole number of 1 or more"),
    ("faults.nlos.windows", 5, "a list of points"),
    ("faults.nlos.windows", [[1, 2, 3]], "a list of [first, last] steps"),
    ("faults.nlos.windows", [[0, 2]], "a list of [first, last] steps"),
    ("faults.nlos.windows", [[1, 2.5]], "a list of [first, last] steps"),
    ("faults.nlos.windows", [[9, 2]], "a list of [first, last] steps"),
    ("faults.nlos.windows", [[1, [2, 3]]], "a number, a list of numbers or a matrix"),
    ("faults.nlos.joint", "yes", "true or false"),
    ("faults.nlos.scale", TEXT, "a number"),
    ("faults.nlos.unit", "deg", "one of m, km, cm, us, ns, sigma"),
    ("start.kind", "anywhere", "one of truth, measurements, bearings"),
    ("start.velocity", [1.0], "a list of 2 numbers"),
    ("start.rows", 0, "a whole number of 1 or more"),
    ("start.position_sigma", -1.0, "a number of 0 or more"),
    ("motion.noise", "white", "one of discrete, continuous"),
    ("parameters.tdoa", 4.0, "a table"),
    ("parameters.tdoa.sigma", 4.0, "a table"),
    ("parameters.tdoa.sigma.value", TEXT, "a number, a list of numbers or a matrix"),
    ("parameters.tdoa.sigma.value", [], "a number, a list of numbers or a matrix"),
    ("parameters.tdoa.sigma.value", [[1.0, 2.0], [3.0]], "a number, a list of numbers or a mat"),
    ("parameters.tdoa.sigma.tuned", "no", "true or false"),
    ("parameters.tdoa.sigma.prior", 0.0, "a number above 0"),
    ("parameters.tdoa.sigma.source", 3, "a text"),
    ("systems", {}, "one system or more"),
    ("systems.ekf", 1, "a table"),
    ("systems.ekf.weight", "andrews", "one of plain, huber, igg3, tanh, danish, tukey, cauchy"),
    ("systems.ekf.standardise", "prior", "one of innovation, noise"),
    ("systems.ekf.iterations", -1, "a whole number of 0 or more"),
    ("systems.ekf.gate", "drop", "one of none, reject, reweigh, inflate"),
    ("systems.ekf.adaptation", "sage-husa", "one of none, innovation-scaling"),
    ("systems.ekf.adaptation", ["sage-husa"], "names among innovation-scaling, credibility, ideal"),
    ("systems.ekf.adaptation", ["strong-tracking"] * 2, "names among innovation-scaling, cred"),
    ("systems.ekf.adaptation", [1], "a list of texts"),
    ("systems.ekf.adaptation", 3, "one of none, innovation-scaling"),
    ("systems.ekf.linearise", "unscented", "one of taylor, cubature"),
    ("systems.ekf.linearise", FLAG, "one of taylor, cubature"),
    ("systems.ekf.fusion", "central", "one of none, distributed"),
    ("systems.chan-ls.linearise", "cubature", "no such key beside estimator = 'chan-ls'"),
    ("systems.taylor-ls.fusion", "distributed", "no such key beside estimator = 'taylor-ls'"),
    ("motion.model", "singer", "one of constant-velocity, coordinated-turn"),
    ("sensors.p", {"kind": "position", "pool": "tdoa"}, "a list of texts"),
    ("sensors.p", {"kind": "position", "pool": ["tdoa"]}, "sensors of as many channels"),
    ("sensors.p", {"kind": "position", "pool": ["radar"]}, "other sensors among tdoa, p"),
    ("systems.ekf.estimator", "ukf", "one of filter, taylor-ls, chan-ls, chan-ekf, bear"),
    ("systems.ekf.scope", "group", "one of channel, sensor, all"),
    ("systems.ekf.scope", ["tdoa_2"], "one of channel, sensor, all"),
    ("systems.ekf.scope", {"a": "tdoa_2"}, "a list of texts"),
    ("systems.ekf.distance", "max", "one of rms, mahalanobis"),
    ("systems.ekf.recovery", "restart", "one of none, widen, inflate"),
    ("systems.ekf.values", 3, "a table"),
    ("systems.ekf.values", {"tdoa.sigma": TEXT}, "a number, a list of numbers or a matrix"),
    ("systems.ekf.values", {"tdoa.sigma": []}, "a number, a list of numbers or a matrix"),
    ("systems.ekf.clairvoyant", 0, "true or false"),
    ("systems.ekf.federated", "yes", "true or false"),
    ("systems.ekf.federated", True, "two sensors or more with it"),
    ("systems.ekf.adaptation", "credibility", "two sensors or more with credibility"),
    ("systems.ekf.adaptation", "ideal-credibility", "two sensors or more with credibility"),
    ("systems.ekf.shares", [0.5, TEXT], "a list of numbers"),
    ("systems.chan-ls.federated", True, "no such key beside estimator = 'chan-ls'"),
    ("systems.taylor-ls.shares", [0.5, 0.5], "no such key beside estimator = 'taylor-ls'"),
    ("sensors.tdoa.every", 0, "a whole number of 1 or more"),
    ("sensors.tdoa.every", 2.0, "a whole number of 1 or more"),
    ("world.ideal_process", TABLE, "an array of tables"),
    ("systems.ekf.sensors", ["radar"], "names among tdoa"),
    ("systems.ekf.sensors", [], "one name or more, none twice"),
    ("systems.ekf.sensors", ["tdoa", "tdoa"], "one name or more, none twice"),
    ("systems.chan-ls.weight", "huber", "no such key beside estimator = 'chan-ls'"),
    ("systems.chan-ls.recovery", "widen", "no such key beside estimator = 'chan-ls'"),
    ("systems.chan-ls.scope", "all", "no such key beside estimator = 'chan-ls'"),
    ("systems.taylor-ls.iterations", 3, "no such key beside estimator = 'taylor-ls'"),
    ("scenes", [{"name": "a", "first": 5, "last": 2}], "a step of first = 5 or later"),
    ("runs", 3, "a table"),
    ("runs.los", 3, "a table"),
    ("references", [{"system": "x", "rmse": 0.0, "source": "y"}], "a number above 0"),
    ("tuning.system", "ukf", "one of taylor-ls, chan-ls"),
    ("tuning.loss", "position", "a table"),
    ("tuning.loss.rmse", 1.0, "a loss among position, likelihood"),
    ("tuning.loss.position", -1.0, "a number of 0 or more"),
    ("tuning.temperature", [0.1, 0.5], "two numbers [first, last] with first >= last > 0"),
    ("tuning.temperature", [0.5, 0.0], "two numbers [first, last] with first >= last > 0"),
    ("tuning.temperature", 0.5, "a list of 2 numbers"),
    ("tuning.batch", 0, "a whole number of 1 or more"),
    ("tuning.steps", 2.5, "a whole number of 0 or more"),
    ("tuning.test", 1, "a whole number of 2 or more"),
    ("tuning.window", 1, "a whole number of 2 or more"),
    ("tuning.learning_rate", 0.0, "a number above 0"),
    ("tuning.clip", -1.0, "a number above 0"),
    ("tuning.patience", 0, "a whole number of 1 or more"),
    ("tuning.starts", "many", "a whole number of 1 or more"),
    ("tuning.degrees", 0, "a number above 0"),
]


@pytest.mark.parametrize(("key", "value", "expected"), WRONG)
def test_a_wrong_value_is_named_with_what_was_expected(key: str, value: Any, expected: str) -> None:
    with pytest.raises(InputError) as caught:
        load_scenario(A, {key: value})
    message = str(caught.value)
    assert "airport-mlat.toml: " in message
    where, _, rest = message.split("airport-mlat.toml: ")[1].partition(": found ")
    assert where.startswith(key) or key.startswith(where.rstrip("."))
    assert f"expected {expected}" in rest
    assert "\n" not in message


#: Key and value; the table in which it stands and the key that was meant (or a known one).
UNKNOWN: list[tuple[str, str]] = [
    ("wrold", "world"),
    ("world.stps", "steps"),
    ("world.acceleration.hihg", "high"),
    ("score_time", "score_times"),
    ("systems.m-ekf.recovry", "recovery"),
    ("systems.m-ekf.linearize", "linearise"),
    ("systems.m-ekf.fusin", "fusion"),
    ("motion.modl", "model"),
    ("systems.m-ekf.distnce", "distance"),
    ("start.velocty", "velocity"),
    ("sensors.tdoa.station", "stations"),
    ("sensors.tdoa.noise.sigm", "sigma"),
    ("faults.nlos.probabilty", "probability"),
    ("start.positon_sigma", "position_sigma"),
    ("motion.nois", "noise"),
    ("parameters.tdoa.sigma.tune", "tuned"),
    ("systems.m-ekf.iteration", "iterations"),
    ("tuning.learning_rat", "learning_rate"),
]


@pytest.mark.parametrize(("key", "meant"), UNKNOWN)
def test_an_unknown_key_is_refused_with_the_one_that_was_meant(key: str, meant: str) -> None:
    message = f"airport-mlat.toml: {key}: unknown key, did you mean {meant!r}?"
    with pytest.raises(InputError, match=re.escape(message)):
        load_scenario(A, {key: 1.0})


@pytest.mark.parametrize(
    "overrides",
    [
        {"world.segments": [{"first": 1, "last": 5, "turn": 3}]},
        {"world.jumps": [{"step": 1, "when": 2}]},
        {"scenes": [{"name": "a", "first": 1, "last": 2, "colour": "red"}]},
        {"sensors.tdoa.noise.schedule": [{"first": 1, "last": 2, "sigma": 1.0, "unit": "m"}]},
        {"sensors.p": {"kind": "position", "height": 3.0}},
        {"axes": 2},
    ],
)
def test_a_key_that_the_table_does_not_know_is_refused(overrides: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"unknown key, (expected one of|did you)"):
        load_scenario(A, overrides)


#: Tables in lists, and values that only fit together.
TOGETHER: list[tuple[str, dict[str, Any], str]] = [
    (A, {"world.segments": [{"first": 5, "last": 5}]}, "world.segments[0].last: found 5, expected"),
    (A, {"world.segments": [{"first": 0}]}, "world.segments[0].last: found nothing"),
    (A, {"world.jumps": [{"step": 0}]}, "world.jumps[0].step: found 0"),
    (
        A,
        {"sensors.tdoa.noise.schedule": [{"first": 4, "last": 3, "sigma": 1.0}]},
        "sensors.tdoa.noise.schedule[0].last: found 3, expected a step of first = 4 or later",
    ),
    (A, {"sensors.more": {"kind": "position", "channels": ["tdoa_2", "b"]}}, "no channel name twi"),
    (A, {"parameters.imq.k.value": 2.0}, "parameters.imq.k: no system has such a parameter"),
    (A, {"parameters.huber.k.value": [1.0, 2.0]}, "parameters.huber.k.value: huber.k: found shape"),
    (A, {"parameters.huber.k.value": -1.0}, "parameters.huber.k.value: huber.k: found -1"),
    (A, {"parameters.tanh.ab.value": [4.0, 1.5]}, "two numbers [a, b] with 0 < a < b"),
    (A, {"parameters.prior.floor.value": 1.5}, "a number between 0 and 1"),
    (A, {"parameters.start.sigma.value": [1.0, 2.0]}, "start.sigma: found shape [2], expected"),
    (A, {"parameters.tdoa.sigma.value": [1.0, 2.0]}, "tdoa.sigma: found shape [2], expected"),
    (A, {"parameters.tdoa.bias.value": [1.0, 2.0]}, "tdoa.bias: expected one number or 7"),
    (A, {"parameters.motion.acceleration.value": [1.0] * 3}, "motion.acceleration: found shape"),
    (A, {"systems.ekf.mad": True}, "systems.ekf: weigh_prior and mad: expected iterations"),
    (A, {"systems.ekf.scope": {"a": ["tdoa_9"]}}, "systems.ekf: scope.a: found 'tdoa_9', expec"),
    (A, {"systems.ekf.scope": {"a": []}}, "systems.ekf: scope.a: found no channel, expected"),
    (
        A,
        {"systems.ekf.scope": {"a": ["tdoa_2"], "b": ["tdoa_3", "tdoa_2"]}},
        "systems.ekf: scope.b: found 'tdoa_2', expected channels among tdoa_2",
    ),
    (A, {"systems.m-ekf-mad.scope": "all"}, "systems.m-ekf-mad: mad: expected scope channel"),
    (
        A,
        {"systems.ekf.recovery": "inflate", "systems.ekf.standardise": "noise"},
        "systems.ekf: recovery inflate: expected standardise innovation, or iterations",
    ),
    (A, {"systems.ekf.values": {"tdoa.sgma": 3.0}}, "systems.ekf: values: found tdoa.sgma, exp"),
    (A, {"systems.ekf.values": {"tanh.ab": [1.0, 2.0]}}, "systems.ekf: values: found tanh.ab, exp"),
    (A, {"systems.ekf.values": {"tdoa.sigma": -3.0}}, "systems.ekf: tdoa.sigma: found -3.0, e"),
    (
        A,
        {"systems.ekf.values": {"tdoa.sigma": [1.0, 2.0]}},
        "tdoa.sigma: found shape [2], expected",
    ),
    (A, {"parameters.recovery.factor.value": 2.0}, "recovery.factor: no system has such a param"),
    (
        A,
        {"parameters.recovery.factor.value": 0.5, "systems.ekf.recovery": "widen"},
        "parameters.recovery.factor.value: recovery.factor: found 0.5, expected a number above 1",
    ),
    (
        A,
        {"start.kind": "bearings"},
        "start.velocity: found nothing, expected 2 numbers beside kind",
    ),
    (A, {"systems.b": {"estimator": "bearing-ls"}}, "systems.b: "),
    (B, {"start.rows": 1}, "start.rows: found 1, expected 2 or more beside kind = 'bearings'"),
    (B, {"start.velocity": [1.0, 2.0, 3.0]}, "start.velocity: found [1.0, 2.0, 3.0], expected a"),
    (B, {"world.axes": 1}, "expected a list of 1 numbers"),
    (B, {"sensors.bearing.platform": ["platform_x", "platform_y"]}, "[world.platform]: none"),
    (B, {"sensors.bearing.height": 3.0}, "sensors.bearing.height: unknown key"),
    (B, {"parameters.bearing.sigma.unit": "m"}, "bearing.sigma.unit: found 'm', expected 'rad'"),
    (
        ABSOLUTE,
        {"sensors.bearing.platform": ["platform_y", "platform_x"]},
        "sensors.bearing.platform: found ['platform_y', 'platform_x'], expected the inputs of "
        "[world.platform]: platform_x, platform_y",
    ),
    (ABSOLUTE, {"world.platform.jumps": []}, "world.platform.jumps: unknown key"),
    (
        URBAN,
        {"systems.standard.shares": [0.5, 0.3, 0.2]},
        "systems.standard: shares: found 3, expected 2, one for each sensor",
    ),
    (URBAN, {"systems.standard.shares": [0.5, 0.6]}, "systems.standard: shares: found [0.5, 0.6],"),
    (
        URBAN,
        {"systems.more": {"shares": [0.5, 0.5]}},
        "systems.more: shares: expected federated with them",
    ),
    (
        URBAN,
        {"systems.credibility.common_noise": True},
        "systems.credibility.adaptation: found 'credibility', expected no credibility together "
        "with common_noise",
    ),
    (
        URBAN,
        {"systems.credibility.sensors": ["position_2"]},
        "systems.credibility.adaptation: found 'credibility', expected two sensors or more",
    ),
    (
        URBAN,
        {"systems.standard.sensors": ["position_2"]},
        "systems.standard.federated: found True, expected two sensors or more with it",
    ),
    (
        URBAN,
        {"world.ideal_process": [{"first": 9, "last": 8, "acceleration": 3.0}]},
        "world.ideal_process[0].last: found 8, expected a step of first = 9 or later",
    ),
    (
        URBAN,
        {"world.ideal_process": [{"first": 0, "last": 8, "acceleration": 3.0}]},
        "world.ideal_process[0].first: found 0, expected a whole number of 1 or more",
    ),
    (
        URBAN,
        {"world.ideal_process": [{"first": 1, "last": 8, "acceleration": 0.0}]},
        "world.ideal_process[0].acceleration: found 0.0, expected a number above 0",
    ),
    (
        URBAN,
        {"world.ideal_process": [{"first": 1, "last": 8, "accel": 3.0}]},
        "world.ideal_process[0].acceleration: found nothing",
    ),
    (
        URBAN,
        {"parameters.credibility.followed.value": 1.5},
        "credibility.followed: found 1.5, expected a number from 0 to 1",
    ),
    (
        URBAN,
        {"parameters.credibility.floor.value": -1.0},
        "credibility.floor: found -1.0, expected a number of 0 or more",
    ),
    (
        URBAN,
        {"parameters.credibility.rate.value": 0.0},
        "credibility.rate: found 0.0, expected a number between 0 and 1",
    ),
    (
        MANOEUVRE,
        {"systems.fusion.sensors": ["r", "a1"]},
        "systems.fusion: fusion: expected three sensors or more of one kind and size",
    ),
    (
        MANOEUVRE,
        {"systems.fusion.weight": "huber"},
        "systems.fusion: weight: expected no weight, gate or other option with fusion",
    ),
    (
        MANOEUVRE,
        {"systems.fusion.adaptation": ["strong-tracking"]},
        "systems.fusion: adaptation: expected no weight, gate or other option with fusion",
    ),
    (
        MANOEUVRE,
        {"systems.srckf.adaptation": ["strong-tracking", "multiple-fading"]},
        "systems.srckf",
    ),
    (
        MANOEUVRE,
        {"parameters.matching.rate.value": 1.0},
        "matching.rate.value: matching.rate: found 1.0, expected a number between 0 and 1",
    ),
    (
        MANOEUVRE,
        {"parameters.correction.lambda.value": -2.0},
        "correction.lambda.value: correction.lambda: found -2.0, expected",
    ),
    (
        MANOEUVRE,
        {"parameters.motion.state_sigma.value": [1.0, 2.0]},
        "motion.state_sigma: found shape [2], expected one number or 4 numbers",
    ),
    (
        "uwb-simulated",
        {"motion.noise": "state"},
        "needs [parameters.motion.state_sigma], found none",
    ),
    (
        MANOEUVRE,
        {"motion.model": "coordinated-turn", "world.axes": 3},
        "expected a list of 3 numbers",
    ),
    (
        U,
        {"faults.f": {"kind": "dropout"}},
        "faults: found {'f': {'kind': 'dropout'}}, expected non",
    ),
    (U, {"start.kind": "true"}, "start.kind: found 'true', expected one of truth, measurements"),
    (U, {"runs.new": {"sensors.range.stations.9": 1.0}}, "runs.new: sensors.range.stations.9: fou"),
    (U, {"runs.new": {"sensors.range.hight": 1.0}}, "sensors.range.hight: unknown key, did you"),
]


@pytest.mark.parametrize(("name", "overrides", "message"), TOGETHER)
def test_what_does_not_fit_together_is_named(
    name: str, overrides: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=re.escape(message)) as caught:
        load_scenario(name, overrides)
    assert f"{name}.toml: " in str(caught.value)


@pytest.mark.parametrize(
    "key",
    ["name", "title", "sensors", "systems", "parameters", "world.dt", "world.position",
     "sensors.tdoa.kind", "sensors.tdoa.stations", "faults.nlos.kind", "faults.nlos.distribution",
     "world.acceleration.low", "parameters.tdoa.sigma.value"],
)  # fmt: skip
def test_a_compulsory_key_is_missed_by_name(key: str) -> None:
    document, path = read_document(A)
    table: Any = copy.deepcopy(document)
    spoiled = table
    *parents, last = key.split(".")
    for parent in parents:
        table = table[parent]
    del table[last]
    with pytest.raises(InputError, match=re.escape(f"airport-mlat.toml: {key}: found nothing")):
        read_scenario(spoiled, path)


def test_a_filter_without_process_noise_is_refused() -> None:
    document, path = read_document(A)
    document = copy.deepcopy(document)
    del document["parameters"]["motion"]
    with pytest.raises(InputError, match=r"systems\.ekf: needs \[parameters\.motion\.acceler"):
        read_scenario(document, path)
