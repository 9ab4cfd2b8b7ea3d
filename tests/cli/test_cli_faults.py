"""Commands in the face of systems that cannot start, leftovers, and damaged contents."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import pytest
import torch
from cli_helpers import TINY, fails, strict_json

import difffilter
from difffilter.cli.main import main
from difffilter.cli.values import own_checkpoint
from difffilter.comparison.table import tabulate
from difffilter.errors import CheckpointError, InputError, digits
from difffilter.files import LEFT, write_atomically, write_together
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.scoring.metrics import Score
from difffilter.tuning.state import load_state, save_state, sound

D = torch.float64


def test_compare_names_the_system_that_cannot_start(tmp_path: Path, capsys: Any) -> None:
    """A system of the bearing alone has no start from measurements; the other one has."""
    path = tmp_path / "two.toml"
    path.write_text(TWO)
    log = tmp_path / "log.csv"
    rows = [f"{t},{1 + t},2,{torch.pi / 4:.6f},{1 + t},2" for t in range(12)]
    log.write_text("\n".join(["time,fix_1,fix_2,bearing,truth_x,truth_y", *rows]) + "\n")
    told = fails(capsys, "compare", path, "--log", log)
    assert "system blind cannot start" in told
    assert "--system seeing" in told
    assert main(["compare", str(path), "--log", str(log), "--system", "seeing"]) == 0


TWO = """\
schema = 1
name = "two"
title = "A fix and a bearing"
axes = 2

[sensors.fix]
kind = "position"

[sensors.bearing]
kind = "bearing"
stations = [[0.0, 0.0]]
channels = ["bearing"]

[motion]
noise = "discrete"

[parameters.motion.acceleration]
value = 1.0

[parameters.fix.sigma]
value = 1.0

[parameters.bearing.sigma]
value = 0.1

[parameters.start.sigma]
value = 10.0

[systems.seeing]
weight = "plain"
sensors = ["fix"]

[systems.blind]
weight = "plain"
sensors = ["bearing"]

[tuning]
system = "seeing"
"""


def test_score_times_beside_the_logs_are_named() -> None:
    time = 1.7e9 + torch.arange(5, dtype=D)[:, None]
    truth = torch.zeros(5, 1, 1, dtype=D)
    log = Log(("x",), time, truth.clone(), truth=truth, truth_states=("x",))
    track = Track(("x",), ("x",), time, truth.clone(), torch.ones(5, 1, 1, 1, dtype=D))
    with pytest.raises(InputError, match=r"score_times: found 50 to 200 s.*1700000000 to"):
        tabulate("a", {("s", "v"): track}, log, wanted=("s", "v"), score=Score("all", 50, 200))
    lost = Track(("x",), ("x",), time, truth + torch.nan, torch.ones(5, 1, 1, 1, dtype=D))
    both = {("s", "v"): track, ("t", "v"): lost}
    with pytest.raises(InputError, match="that t v has an estimate for; without it: --system s"):
        tabulate("a", both, log, wanted=("s", "v"))


def test_leftovers_of_killed_writers_go_with_the_next_write(tmp_path: Path) -> None:
    old, young, other = (
        tmp_path / n for n in (".a.csv.abcdefgh", ".a.csv.ijklmnop", ".b.csv.abcdefgh")
    )
    aside = tmp_path / ".difffilter-abcdefgh"
    aside.mkdir()
    (aside / "half").write_text("half")
    for path in (old, young, other):
        path.write_text("half")
    for path in (old, other, aside):
        os.utime(path, (1.0, 1.0))
    write_atomically(tmp_path / "a.csv", "whole")
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(
        ["a.csv", young.name, other.name, aside.name]
    )
    write_together(tmp_path, {"c.txt": "whole"})
    assert not aside.exists()
    assert LEFT > 60.0


def test_a_state_with_the_right_digest_and_a_wrong_content(tmp_path: Path) -> None:
    path = tmp_path / "x.state.pt"
    save_state(path, {"fingerprint": "f"})
    state = load_state(path, "f")
    with pytest.raises(CheckpointError, match=r"x\.state\.pt: damaged"), sound(path):
        state["course"]


def test_simulating_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first part is what one part gives, the next ones are others; all files are there."""
    from difffilter.cli import simulate

    monkeypatch.chdir(tmp_path)
    Path("tiny.toml").write_text(TINY)
    arguments = ["simulate", "tiny.toml", "--quiet", "--trajectories"]
    assert main([*arguments, "2", "--out", "whole"]) == 0
    monkeypatch.setattr(simulate, "PART", 40)  # two trajectories of twenty rows
    assert main([*arguments, "5", "--out", "parts"]) == 0
    read = [path.read_text() for path in sorted(Path("parts").iterdir())]
    assert read[:2] == [path.read_text() for path in sorted(Path("whole").iterdir())]
    assert len(set(read)) == 5


def test_tuned_values_follow_what_a_scenario_extends(tmp_path: Path) -> None:
    (tmp_path / "tiny.toml").write_text(TINY)
    (tmp_path / "tinier.toml").write_text(
        'schema = 1\nextends = "tiny.toml"\nname = "tinier"\n[world]\nsteps = 9\n'
    )
    scenario = difffilter.load_scenario(tmp_path / "tinier.toml")
    assert own_checkpoint(scenario, inherited=True).name == "airport-mlat.json"
    assert own_checkpoint(scenario).name == "tinier.json"


def test_values_are_shown_in_the_unit_that_they_were_given_in(capsys: Any) -> None:
    capsys.readouterr()
    assert main(["show", "airborne-bearing"]) == 0
    line = next(x for x in capsys.readouterr().out.splitlines() if "bearing.sigma" in x)
    assert " deg " in line
    assert main(["show", "airborne-bearing", "--json"]) == 0
    entries = strict_json(capsys.readouterr().out)["parameters"]
    entry = next(e for e in entries if e["name"] == "bearing.sigma")
    shown = float(line.split()[1])
    assert entry["unit"] == "rad"
    assert entry["value"] == pytest.approx(shown * torch.pi / 180.0, rel=1e-6)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.00034, "0.00034"),
        (0.0, "0"),
        (6.14159, "6.142"),
        (-0.5, "-0.500"),
        (123456.0, "1.235e+05"),
    ],
)
def test_digits(value: float, text: str) -> None:
    assert digits(value) == text
