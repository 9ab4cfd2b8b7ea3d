"""Help, version, listings, interruption and closed pipes."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from cli_helpers import TINY, environment, process, strict_json, succeeds

import difffilter
from difffilter.cli.main import main

COMMANDS = [
    "scenarios", "show", "simulate", "import", "tune", "compare", "run", "report", "export", "bench"
]  # fmt: skip
#: What these write are files alone.
WITHOUT_JSON = {"report", "export"}


@pytest.mark.parametrize("command", COMMANDS)
def test_help_has_an_example(capsys: Any, command: str) -> None:
    assert main([command, "--help"]) == 0
    text = capsys.readouterr().out
    assert text.startswith(f"usage: difffilter {command}")
    assert f"  difffilter {command}" in text.split("example")[1]
    assert ("--json" in text) == (command not in WITHOUT_JSON)


def test_help_and_version_in_a_process() -> None:
    text = succeeds("--help")
    for command in COMMANDS:
        assert f"    {command}" in text
    assert succeeds("--version") == f"difffilter {version('difffilter')}\n"


def test_scenarios(capsys: Any) -> None:
    listed = strict_json(succeeds("scenarios", "--json"))["scenarios"]
    assert [entry["name"] for entry in listed] == difffilter.scenario_names()
    recorded = {entry["name"] for entry in listed if entry["recorded"]}
    assert "uwb-ranges" in recorded
    assert "airport-mlat" not in recorded
    assert main(["scenarios"]) == 0
    text = capsys.readouterr().out
    assert [line.split()[0] for line in text.splitlines()[1:]] == difffilter.scenario_names()


def test_show_prints_world_and_published_values(capsys: Any) -> None:
    assert main(["show", "airport-mlat", "--set", "world.steps=7"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "  world.steps = 7" in lines
    (sigma,) = [line for line in lines if line.startswith("  tdoa.sigma")]
    assert sigma.split() == ["tdoa.sigma", "10", "ns", "yes", "paper", "3"]


@pytest.mark.parametrize("name", difffilter.scenario_names())
def test_show_json(capsys: Any, name: str) -> None:
    assert main(["show", name, "--json"]) == 0
    shown = strict_json(capsys.readouterr().out)
    scenario = difffilter.load_scenario(name)
    assert shown["name"] == name
    assert shown["channels"] == list(scenario.channels)
    assert ("world" in shown) == (scenario.world is not None)
    declared = scenario.declarations()
    assert [entry["name"] for entry in shown["parameters"]] == list(declared)
    for entry in shown["parameters"]:
        parameter = declared[entry["name"]]
        assert (entry["unit"], entry["source"]) == (parameter.unit, parameter.source)
        assert entry["value"] == parameter.tensor().tolist()
    assert main(["show", name]) == 0


def test_show_lines_are_keys_for_set(capsys: Any) -> None:
    """Every line of the world, given back as --set, is accepted and changes nothing."""
    assert main(["show", "airport-mlat-intermittent"]) == 0
    plain = capsys.readouterr().out
    world = plain.split("\nPublished values")[0].splitlines()
    keys = [line.strip().replace(" = ", "=") for line in world if " = " in line]
    assert len(keys) > 20
    options = [word for key in keys for word in ("--set", key)]
    assert main(["show", "airport-mlat-intermittent", *options]) == 0
    assert capsys.readouterr().out == plain


def test_closed_pipe() -> None:
    """A reader that goes away is no error to complain about."""
    command = [sys.executable, "-m", "difffilter", "show", "airport-mlat", "--json"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=environment()
    ) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.close()
        assert running.stderr.read() == b""
        assert running.wait(60) == 141


#: Ctrl-C in the third step, by the process itself: no other one has to be quick enough.
INTERRUPTED = """
import signal, sys
from difffilter.cli.main import main
from difffilter.tuning.descent import Descent
original, count = Descent._step, 0
def step(self, *args):
    global count
    count += 1
    if count == 3:
        signal.raise_signal(signal.SIGINT)
    return original(self, *args)
Descent._step = step
signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where tests run behind
sys.exit(main(sys.argv[1:]))
"""


def test_interrupted_tuning_says_how_to_resume(tmp_path: Path) -> None:
    (tmp_path / "tiny.toml").write_text(TINY)
    options = ["tune", "tiny.toml", "--system", "ekf", "--steps", "5", "--out", "a.json"]
    options += ["--set", "tuning.evaluate_every=1", "--set", "tuning.patience=99"]
    done = subprocess.run(
        [sys.executable, "-c", INTERRUPTED, *options],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment(),
        timeout=400,
        check=False,
    )
    assert done.returncode == 130, done.stderr
    assert done.stdout == ""
    told = f"difffilter: interrupted; go on with: difffilter {' '.join(options)} --resume\n"
    assert done.stderr == told
    assert not (tmp_path / "a.json").exists()
    done = process(*options, "--resume", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert difffilter.load(tmp_path / "a.json").system == "ekf"
    assert not (tmp_path / "a.state.pt").exists()
