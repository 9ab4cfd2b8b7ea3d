"""Systems of several modes in scenario files."""

from __future__ import annotations

import math

import pytest

from difffilter import InputError, Mixture, estimate, load_scenario, simulate, started

NAME = "manoeuvre-fusion-1"


def test_the_scenes_have_two_hand_picked_mixtures() -> None:
    scenario = load_scenario(NAME)
    imm, turns = scenario.system("imm"), scenario.system("imm-turns")
    assert isinstance(imm, Mixture)
    assert isinstance(turns, Mixture)
    assert list(imm.modes) == ["calm", "wild"]
    assert list(turns.modes) == ["calm", "left", "right", "wide"]
    assert turns.declarations["motion.turn_rate"].value == pytest.approx(math.radians(4.0))
    tuned = {name for name, p in turns.declarations.items() if p.tuned}
    assert tuned == {
        "calm.motion.state_sigma", "left.motion.state_sigma", "right.motion.state_sigma",
        "wide.motion.state_sigma", "motion.turn_rate", "modes.rate", "modes.share", "pooled.sigma",
    }  # fmt: skip
    tuned = {name for name, p in imm.declarations.items() if p.tuned}
    assert tuned == {
        "calm.motion.state_sigma", "wild.motion.acceleration", "modes.rate", "modes.share",
        "pooled.sigma",
    }  # fmt: skip


def test_a_mixture_runs_in_its_scene() -> None:
    scenario = load_scenario(NAME, {"world.steps": 20})
    system = scenario.system("imm")
    log = started(scenario, system, simulate(scenario, 3, seed=2))
    track = estimate(system, log)
    assert track.mean.shape == (20, 3, 4)


WRONG = [
    ({"systems.imm.weight": "huber"}, r"systems\.imm\.weight: .*each mode has its own"),
    ({"systems.imm.modes.calm.fusion": "distributed"}, "no such key in a mode"),
    ({"systems.imm.modes.calm.colour": 1}, "colour: unknown key"),
    ({"systems.imm.modes.calm.motion": {"model": "warp"}}, "model"),
    ({"systems.imm.estimator": "taylor-ls"}, r"modes: .*no such key beside estimator"),
]


@pytest.mark.parametrize(("overrides", "message"), WRONG)
def test_a_wrong_mode_is_one_clear_error(overrides: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        load_scenario(NAME, overrides)
