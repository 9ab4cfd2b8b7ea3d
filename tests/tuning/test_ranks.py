"""Several processes tune together as one would, and the loss of one is told."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from difffilter.errors import InputError
from difffilter.tuning.processes import Ranks

SETTINGS = {
    "trajectories": 9, "validation": 5, "test": 4, "batch": 5, "steps": 6, "evaluate_every": 2,
}  # fmt: skip
TWO = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node=2"]
#: The process of that rank dies in its third step.
DYING = """
import os, sys
from difffilter.cli.main import main
from difffilter.tuning.descent import Descent
original, count = Descent._step, 0
def step(self, *args):
    global count
    count += 1
    if os.environ.get("DYING") == os.environ["RANK"] and count == 3:
        os._exit(9)
    return original(self, *args)
Descent._step = step
sys.exit(main(sys.argv[1:]))
"""


def command(out: Path, optimiser: str, engine: str) -> list[str]:
    settings = [f"--set=tuning.{key}={value}" for key, value in SETTINGS.items()]
    return [
        "tune", "airport-mlat-intermittent", *settings, "--set=world.steps=20",
        f"--set=tuning.optimiser={optimiser}", f"--engine={engine}", "--out", str(out), "--quiet",
    ]  # fmt: skip


def call(words: list[str], **extra: str) -> subprocess.CompletedProcess[str]:
    environment = os.environ | {"OMP_NUM_THREADS": "1"} | extra
    return subprocess.run(words, capture_output=True, text=True, env=environment, check=False)


def tuned(path: Path) -> dict[str, object]:
    return {k: v["value"] for k, v in json.loads(path.read_text())["parameters"].items()}


@pytest.mark.parametrize(
    ("optimiser", "engine"),
    [("adam", "torch"), ("lbfgs", "fused"), ("adam", "fused"),
     ("gauss-newton", "fused")],
)  # fmt: skip
def test_two_processes_tune_the_values_of_one(tmp_path: Path, optimiser: str, engine: str) -> None:
    alone, both = tmp_path / "alone.json", tmp_path / "both.json"
    assert call([sys.executable, "-m", "difffilter", *command(alone, optimiser, engine)]).stdout
    done = call([*TWO, "-m", "difffilter", *command(both, optimiser, engine)])
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("checkpoint written to") == 1
    expected, found = tuned(alone), tuned(both)
    published = json.loads(alone.read_text())["parameters"]["tdoa.sigma"]["published"]
    assert expected["tdoa.sigma"] != published
    for name, value in expected.items():
        assert found[name] == pytest.approx(value, rel=1e-9), name


def test_a_lost_process_ends_the_run_with_one_line_and_a_state_that_resumes(tmp_path: Path) -> None:
    script = tmp_path / "dying.py"
    script.write_text(DYING)
    whole, cut = tmp_path / "whole.json", tmp_path / "cut.json"
    assert call([*TWO, "-m", "difffilter", *command(whole, "gauss-newton", "fused")]).stdout
    words = command(cut, "gauss-newton", "fused")
    done = call([*TWO, str(script), *words], DYING="1")
    assert done.returncode != 0
    lines = [line for line in done.stderr.splitlines() if line.startswith("difffilter: error:")]
    assert len(lines) == 1
    assert lines[0].startswith("difffilter: error: ranks: process 0 of 2 ")
    assert lines[0].endswith("; go on with --resume")
    assert not cut.exists()
    again = call([*TWO, "-m", "difffilter", *words, "--resume"])
    assert again.returncode == 0, again.stderr
    assert tuned(cut) == tuned(whole)


def test_each_process_gets_its_share_and_every_trajectory_has_one() -> None:
    index = torch.arange(11)
    parts = [Ranks(rank, 3).share(index) for rank in range(3)]
    assert sorted(torch.cat(parts).tolist()) == index.tolist()
    assert max(map(len, parts)) - min(map(len, parts)) <= 1
    with pytest.raises(InputError, match="found 2 trajectories for 3 processes"):
        Ranks(0, 3).share(index[:2])


def test_alone_nothing_is_sent() -> None:
    x = torch.ones(3, requires_grad=True)
    alone = Ranks()
    assert alone.first
    assert alone.add(x) is x
    assert alone.differentiable_sum(x) is x
    assert alone.told(b"state") == b"state"
