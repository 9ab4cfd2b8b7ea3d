"""Twelve planted traps and twelve honest improvements, judged by the page's own rule."""

from __future__ import annotations

from typing import Any

import pytest
from planted import judged, planted, shifted

from difffilter import simulate
from difffilter.verdict.evidence import Evidence

pytestmark = pytest.mark.usefixtures("quick_compiler")

GOOD = {"radio.sigma": [3.0, 3.0]}
FREE = {"standard_errors": {"motion.acceleration": None},
        "undetermined": ["motion.acceleration: the data do not determine it"]}  # fmt: skip
CLUTTER = {"kind": "offset", "channels": ["radio_*"], "size": "constant"}

#: What is wrong, values, changes of the world, the record of the tuning, what the page names.
TRAPS: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any], str]] = {
    "bias that no residual supports": ({**GOOD, "radio.bias": [14.0, 0.0]}, {}, {}, "bias"),
    "dead sensor": ({"radio.sigma": [3.0, 3.0], "gps.sigma": [45.0, 45.0]}, {}, {}, "sensor-off"),
    "dead process noise": (
        {"radio.sigma": [3.0, 3.0], "motion.acceleration": 0.005}, {}, {}, "process-noise"),
    "proud along one axis": (
        {"radio.sigma": [3.0, 0.9], "gps.sigma": [3.0, 0.9]}, {}, {}, "direction"),
    "timid of its velocity": ({**GOOD, "motion.acceleration": 30.0}, {}, {}, "half the rate"),
    "capped": (GOOD, {}, {"end": "steps"}, "capped"),
    "out of filter runs": (GOOD, {}, {"end": "runs"}, "capped"),
    "not determined": ({**GOOD, "motion.acceleration": 1.1}, {}, FREE, "undetermined"),
    "start memorised": (
        {**GOOD, "start.sigma": [0.1, 0.1, 0.02, 0.02]}, {}, {}, "start off"),
    "a calm world memorised": (
        {**GOOD, "motion.acceleration": 0.08},
        {"world.acceleration.sigma": 0.05}, {}, "a turn"),
    "faults memorised": (
        {**GOOD, "radio.bias": [14.0, 14.0]},
        {"faults.mast": {"kind": "offset", "channels": ["radio_*"], "distribution": "constant",
                         "value": 14.0}},
        {}, "faults off"),
    "a stated world forgotten": (
        {**GOOD, "motion.acceleration": 0.2},
        {"world.acceleration.sigma": 0.2,
         "worlds": [{"name": "chase", "plausible": "it flees",
                     "overrides": {"world.acceleration.sigma": 4.0}}]},
        {}, "chase"),
}  # fmt: skip


@pytest.mark.parametrize("trap", TRAPS)
def test_a_trap_is_named_and_not_adopted(trap: str) -> None:
    values, changes, training, named = TRAPS[trap]
    found = judged(planted(values, changes, **training))
    assert found.grade.word != "adopt"
    assert named in names(found)


def names(found: Evidence) -> set[str]:
    """Kinds of flags, and conditions that a term of the page names."""
    told = {flag.kind for flag in found.flags}
    texts = [term.text for term in found.grade.terms]
    return told | {s.name for s in found.stressed if any(s.text in text for text in texts)}


def test_values_that_know_their_training_data_are_named() -> None:
    checkpoint = planted({**GOOD, "radio.bias": [2.0, 2.0]})
    train = shifted(simulate(checkpoint.scenario, 24, 9, "train"), 4.0)
    found = judged(checkpoint, train=train)
    assert "overfit" in {flag.kind for flag in found.flags}
    assert found.grade.word != "adopt"


#: Values, and the world and its published values.
HONEST: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "sigma as it is": (GOOD, {}),
    "sigma nearly as it is": ({"radio.sigma": [3.4, 3.4]}, {}),
    "one sigma for each axis": ({"radio.sigma": [2.8, 3.3]}, {}),
    "sigma published too small": (
        {"radio.sigma": [9.0, 9.0]},
        {"parameters.radio.sigma.value": [2.0, 2.0], "sensors.radio.noise.sigma": 9.0}),
    "a worse receiver": (
        {"radio.sigma": [6.0, 6.0]},
        {"parameters.radio.sigma.value": [1.0, 1.0], "sensors.radio.noise.sigma": 6.0}),
    "process noise as it is": (
        {**GOOD, "motion.acceleration": 1.0}, {"parameters.motion.acceleration.value": 0.2}),
    "process noise nearly as it is": (
        {**GOOD, "motion.acceleration": 0.8}, {"parameters.motion.acceleration.value": 0.3}),
    "process noise alone": (
        {"motion.acceleration": 1.0}, {"parameters.motion.acceleration.value": 0.25}),
    "a bias that is there": (
        {**GOOD, "radio.bias": [0.2, -0.2]}, {}),
    "start as it is": ({**GOOD, "start.sigma": [2.8, 2.9, 1.1, 0.9]}, {}),
    "both receivers": (
        {"radio.sigma": [3.0, 3.0], "gps.sigma": [3.0, 3.0]},
        {"parameters.gps.sigma.value": [6.0, 6.0], "parameters.radio.sigma.value": [30.0, 30.0]}),
    "everything a little": (
        {"radio.sigma": [3.1, 3.2], "gps.sigma": [2.9, 3.1], "motion.acceleration": 1.1}, {}),
}  # fmt: skip


@pytest.mark.parametrize("case", HONEST)
def test_an_honest_improvement_is_adopted_without_a_flag(case: str) -> None:
    values, changes = HONEST[case]
    found = judged(planted(values, changes, end="converged"))
    assert [flag.text for flag in found.flags] == []
    assert found.grade.text.startswith("Adopt: ")
    assert found.grade.terms == ()


def test_no_condition_is_tested_twice() -> None:
    found = judged(planted(GOOD))
    figures = [(one.published, one.tuned) for one in found.stressed]
    assert len(set(figures)) == len(figures) > 10
    base = (found.table.rows[0].rmse, found.table.rows[1].rmse)
    assert base not in figures
