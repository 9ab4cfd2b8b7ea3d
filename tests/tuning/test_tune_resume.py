"""A tuning run that is killed and resumed ends with the same bits as one left alone."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from resume_cases import STEPS, WINDOWED, Run, kill_after, same, simulated
from tune_cases import FEW, airport, recorded

import difffilter
from difffilter.errors import CheckpointError
from difffilter.logs.log import Log
from difffilter.scenario.scenario import Scenario, load_scenario
from difffilter.tuning.loop import TuneResult, tune
from difffilter.tuning.state import state_path


def on_recordings(tmp_path: Path) -> Run:
    scenario, log = load_scenario("uwb-ranges"), recorded(tmp_path)

    def run(**options: Any) -> TuneResult:
        fixed: dict[str, Any] = {"seed": 1, "train": log, "test": log, "settings": STEPS | WINDOWED}
        return tune(scenario, **fixed | options)

    return run


def adaptive(tmp_path: Path) -> Run:
    """Windows whose warm starts carry the memory of an adaptation."""
    scenario: Scenario = load_scenario(
        "uwb-ranges", {"systems.ekf.adaptation": "innovation-scaling", "tuning.system": "ekf"}
    )
    log: Log = recorded(tmp_path)

    def run(**options: Any) -> TuneResult:
        fixed: dict[str, Any] = {"seed": 1, "train": log, "test": log, "settings": STEPS | WINDOWED}
        return tune(scenario, **fixed | options)

    return run


@pytest.mark.parametrize("after", [1, 4, 11])
@pytest.mark.parametrize("make", [simulated, on_recordings, adaptive])
def test_a_killed_run_resumes_to_the_same_bits(
    tmp_path: Path, make: Callable[[Path], Run], after: int
) -> None:
    run, out = make(tmp_path), tmp_path / "x.json"
    expected = run()
    with pytest.MonkeyPatch.context() as patch:
        kill_after(patch, after)
        with pytest.raises(KeyboardInterrupt):
            run(out=out)
    assert not out.exists()
    assert state_path(out).is_file()
    resumed = run(out=out, resume=True)
    same(resumed, expected)
    assert not state_path(out).exists()
    assert difffilter.load(out).training == expected.checkpoint.as_dict()["training"]


@pytest.mark.parametrize("after", [1, 2, 3])
def test_patience_counts_on_across_an_interruption(tmp_path: Path, after: int) -> None:
    """The first start overshoots and is stopped early; resuming must not grant it more."""
    harsh = {"learning_rate": 6.0, "patience": 3, "evaluate_every": 1, "steps": 12, "system": "ekf"}
    scenario = airport(faults__nlos__probability=0.0)

    def run(**options: Any) -> TuneResult:
        return tune(scenario, seed=1, settings=FEW | harsh, **options)

    expected, out = run(), tmp_path / "x.json"
    assert expected.history[-1].step == 3
    with pytest.MonkeyPatch.context() as patch:
        kill_after(patch, after)
        with contextlib.suppress(KeyboardInterrupt):
            run(out=out)
    if after < 3:
        same(run(out=out, resume=True), expected)
    else:
        assert difffilter.load(out).training["step"] == 0  # it had ended by itself


def test_a_run_killed_twice_resumes_to_the_same_bits(tmp_path: Path) -> None:
    run, out = on_recordings(tmp_path), tmp_path / "x.json"
    expected = run()
    for steps, resume in ((3, False), (5, True)):
        with pytest.MonkeyPatch.context() as patch:
            kill_after(patch, steps)
            with pytest.raises(KeyboardInterrupt):
                run(out=out, resume=resume)
    same(run(out=out, resume=True), expected)


def test_a_process_that_dies_resumes_to_the_same_bits(tmp_path: Path) -> None:
    """No handler runs: the process exits from within the fourth gradient step."""
    script = f"""
import os, sys
sys.path.insert(0, {str(Path(__file__).parents[1])!r})
from pathlib import Path
from resume_cases import Descent, simulated
count, original = 0, Descent._step
def step(self, *args):
    global count
    count += 1
    if count == 4:
        os._exit(9)
    return original(self, *args)
Descent._step = step
simulated(None)(out=sys.argv[1])
"""
    out = tmp_path / "x.json"
    done = subprocess.run(
        [sys.executable, "-c", script, str(out)],
        env=os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())},
        capture_output=True,
        timeout=100,
    )
    assert done.returncode == 9, done.stderr.decode()
    assert sorted(path.name for path in tmp_path.iterdir()) == [".x.state.pt.lock", "x.state.pt"]
    run = simulated(tmp_path)
    same(run(out=out, resume=True), run())


@pytest.fixture
def interrupted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a run's state stands after three steps."""
    out = tmp_path / "x.json"
    with pytest.MonkeyPatch.context() as patch:
        kill_after(patch, 3)
        with pytest.raises(KeyboardInterrupt):
            simulated(tmp_path)(out=out)
    return out


OTHERS: dict[str, dict[str, Any]] = {
    "seed": {"seed": 2},
    "learning rate": {"settings": FEW | STEPS | {"learning_rate": 0.01}},
    "steps": {"settings": FEW | STEPS | {"steps": 8}},
    "loss": {"settings": FEW | STEPS | {"loss": {"likelihood": 1.0}}},
    "system": {"settings": FEW | STEPS | {"system": "ekf"}},
}


@pytest.mark.parametrize("name", OTHERS)
def test_another_run_does_not_resume(interrupted: Path, name: str) -> None:
    before = state_path(interrupted).read_bytes()
    with pytest.raises(CheckpointError, match=r"x\.state\.pt: belongs to another run"):
        simulated(interrupted.parent)(out=interrupted, resume=True, **OTHERS[name])
    assert state_path(interrupted).read_bytes() == before


def test_another_scenario_does_not_resume(interrupted: Path) -> None:
    with pytest.raises(CheckpointError, match="belongs to another run"):
        tune(airport(13), seed=1, settings=FEW | STEPS, out=interrupted, resume=True)


@pytest.mark.parametrize("part", ["z", "truth", "time"])
def test_other_logs_do_not_resume(tmp_path: Path, part: str) -> None:
    from dataclasses import replace

    run, out, log = on_recordings(tmp_path), tmp_path / "x.json", recorded(tmp_path)
    with pytest.MonkeyPatch.context() as patch:
        kill_after(patch, 3)
        with pytest.raises(KeyboardInterrupt):
            run(out=out)
    other = replace(log, **{part: getattr(log, part) * 1.0000001})
    with pytest.raises(CheckpointError, match="belongs to another run"):
        run(out=out, train=other, resume=True)


def test_a_run_that_never_began_does_not_resume(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match=r"x\.state\.pt: found no such file"):
        simulated(tmp_path)(out=tmp_path / "x.json", resume=True)


def test_without_resume_a_run_starts_anew(interrupted: Path) -> None:
    run = simulated(interrupted.parent)
    same(run(out=interrupted), run())
