"""Code in a name: refused where a file brings it, mere text where Python does."""

from __future__ import annotations

import json
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from cli_helpers import process

import difffilter as df

CC = shutil.which("cc") or shutil.which("gcc")
NAME = r"""p */
#ifndef Q
#define Q
#include <stdlib.h>
__attribute__((constructor)) static void f(void) { if (system("id > PWNED")) {} }
#endif
/*"""
SCENARIO = f"""
schema = 1
name = "harmless"
title = "x"
[world]
dt = 1.0
steps = 10
position = [0.0, 0.0]
velocity = [1.0, 0.0]
[sensors.{json.dumps(NAME)}]
kind = "position"
channels = ["px", "py"]
[parameters.motion.acceleration]
value = 1.0
tuned = true
[parameters.start.sigma]
value = 1.0
[systems.ekf]
"""


def refused(folder: Path, *arguments: object) -> str:
    before = sorted(folder.iterdir())
    done = process(*arguments, cwd=folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("difffilter: error: ")
    assert done.stderr.count("\n") == 1
    assert "\x1b" not in done.stderr
    assert sorted(folder.iterdir()) == before
    return done.stderr


@pytest.mark.parametrize(
    "command", ["tune bad.toml --steps 2 --out bad.json", "show bad.toml", "compare bad.toml"]
)
def test_a_scenario_with_code_in_a_name_is_refused(command: str, tmp_path: Path) -> None:
    (tmp_path / "bad.toml").write_text(SCENARIO)
    said = refused(tmp_path, *command.split())
    assert "bad.toml: sensors.'p */" in said
    assert "expected a name: a letter, then letters, digits, _ and -, at most 64" in said


def test_a_checkpoint_with_code_in_a_name_is_refused(tmp_path: Path) -> None:
    (tmp_path / "good.toml").write_text(SCENARIO.replace(json.dumps(NAME), "position"))
    scenario = df.load_scenario(tmp_path / "good.toml")
    recipe = scenario.system("ekf")
    assert isinstance(recipe, df.Filter)
    df.save(df.Checkpoint(scenario, "ekf", recipe.published()), tmp_path / "bad.json")
    text = (tmp_path / "bad.json").read_text()
    assert text.count('"position"') >= 2
    (tmp_path / "bad.json").write_text(text.replace('"position": {', f"{json.dumps(NAME)}: {{"))
    assert "a letter, then letters" in refused(
        tmp_path, "export", "bad.json", "--to", "c", "--out", "c"
    )


@pytest.mark.skipif(CC is None, reason="no C compiler")
def test_a_filter_with_code_in_its_names_is_tuned_exported_and_compiled_as_text(
    tmp_path: Path,
) -> None:
    sensor = df.Position(name=NAME, sigma=1.0)
    recipe = df.Filter(df.ConstantVelocity(), (sensor,), start_sigma=1.0)

    def simulate(seed: int, count: int) -> df.Log:
        random = torch.Generator().manual_seed(seed)
        time = torch.arange(1.0, 11.0, dtype=torch.float64)
        truth = torch.stack([time, torch.zeros_like(time)], dim=-1)[:, None].expand(-1, count, -1)
        noise = torch.randn(truth.shape, generator=random, dtype=torch.float64)
        return df.Log(recipe.channels, time, truth + noise, truth=truth, truth_states=("x", "y"))

    model = df.Model(recipe, "m", simulate, title=NAME, notes=(NAME,))
    settings = {"steps": 2, "trajectories": 4, "validation": 4, "test": 4, "batch": 4}
    result = df.tune(model, settings=settings, tuned=[f"{NAME}.sigma"])
    assert result.held_out is not None
    table = result.held_out.markdown().splitlines()
    assert len(table) == 2 + len(result.held_out.rows)

    df.export_c(result.checkpoint, tmp_path, "one")
    command = [str(CC), "-std=c99", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    command += ["one.c", "one_test.c", "-o", "check", "-lm"]
    made = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert made.returncode == 0, made.stderr
    done = subprocess.run(["./check"], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout
    assert not (tmp_path / "PWNED").exists()
    told = (tmp_path / "one.h").read_text()
    assert "PWNED" in told  # in a comment, so that this test tests something
    assert not any(line.lstrip().startswith("__attribute__") for line in told.splitlines())


def test_a_comparisons_table_holds_names_as_text() -> None:
    time = torch.arange(3, dtype=torch.float64)
    z = torch.zeros(3, 1, 2, dtype=torch.float64)
    recipe = df.Filter(df.ConstantVelocity(), (df.Position(sigma=1.0),), start_sigma=1.0)
    log = df.Log(recipe.channels, time, z, truth=z, truth_states=("x", "y"))
    name = "<script>|`[x](y)`\n\x1b[2J"
    begin = df.Start(torch.zeros(4).double(), torch.eye(4).double())
    with pytest.raises(df.InputError, match="name: found"):
        df.Model(recipe, name, start=begin)
    found = df.compare(df.Model(recipe, "plain", start=begin), log=log)
    found = replace(found, rows=tuple(replace(row, system=name) for row in found.rows))
    lines = found.markdown().splitlines()
    assert len(lines) == 2 + len(found.rows)
    for line in lines[2:]:
        assert "\x1b" not in line
        assert r"\<script\>\|\`\[x\](y)\`" in line
