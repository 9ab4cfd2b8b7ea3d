"""Wrong input: exit code 2 and one line that names what is wrong; nothing is written."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from cli_helpers import TINY, check_failure, fails, process

import difffilter
from difffilter.cli.main import main


@pytest.fixture(scope="module")
def sources(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scenario, a log and a checkpoint, all sound."""
    folder = tmp_path_factory.mktemp("sound")
    (folder / "tiny.toml").write_text(TINY)
    tiny, log = str(folder / "tiny.toml"), str(folder / "log.csv")
    assert main(["simulate", tiny, "--trajectories", "1", "--out", log]) == 0
    scenario = difffilter.load_scenario(tiny)
    values = scenario.system("m-ekf").published()
    difffilter.save(difffilter.Checkpoint(scenario, "m-ekf", values), folder / "frozen.json")
    return folder


@pytest.fixture
def place(sources: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current folder, with copies to spoil."""
    monkeypatch.chdir(tmp_path)
    for path in sources.iterdir():
        Path(path.name).write_bytes(path.read_bytes())
    return tmp_path


#: Arguments, and what the one line must name.
ARGUMENTS = {
    "no command": ("", ["COMMAND"]),
    "unknown command": ("tun airport-mlat", ["'tun'", "tune"]),
    "unknown option": ("show tiny.toml --jsn", ["--jsn"]),
    "abbreviated option": ("compare tiny.toml --traj 5", ["--traj"]),
    "unknown scenario": ("show airport-mlatt", ["'airport-mlatt'", "did you mean airport-mlat?"]),
    "missing scenario file": ("show none.toml", ["none.toml"]),
    "wrong key": ("show tiny.toml --set wrold.steps=3", ["tiny.toml: wrold: unknown key", "world"]),
    "wrong nested key": ("simulate tiny.toml --out d --set world.stps=3", ["world.stps", "steps"]),
    "wrong value": ("compare tiny.toml --set world.steps=-3", ["world.steps", "-3", "1 or more"]),
    "text as value": ("tune tiny.toml --set world.dt=fast", ["world.dt", "'fast'", "a number"]),
    "value not finite": ("show tiny.toml --set world.dt=nan", ["world.dt", "nan"]),
    "set without value": ("show tiny.toml --set world.dt", ["--set", "key.path=value"]),
    "no trajectories": ("simulate tiny.toml --out d --trajectories 0", ["--trajectories", "'0'"]),
    "negative seed": ("compare tiny.toml --seed -1", ["--seed", "'-1'", "0 or more"]),
    "steps not a number": ("tune tiny.toml --steps many", ["--steps", "'many'"]),
    "no steps": ("tune tiny.toml --steps 0", ["--steps", "'0'", "1 or more"]),
    "many logs in a file": ("simulate tiny.toml --out one.csv", ["one.csv", "100 trajectories"]),
    "more than the disk": (
        "simulate tiny.toml --out d --trajectories 99999999999", ["GB of disk", "trajectories"],
    ),
    "far more than the disk": (
        f"simulate tiny.toml --out d --trajectories {10**22}", ["GB of disk", "trajectories"],
    ),
    "a world without end": (
        "simulate tiny.toml --out d --trajectories 2 --set world.dt=1e308", ["world.dt"],
    ),
    "file as a folder": ("simulate tiny.toml --out log.csv/logs", ["log.csv"]),
    "recorded only": ("simulate uwb-ranges --out d", ["uwb-ranges", "[world]"]),
    "compare without log": ("compare uwb-ranges", ["uwb-ranges", "--log"]),
    "tune without log": ("tune uwb-ranges", ["uwb-ranges", "--log"]),
    "unknown loss": ("tune tiny.toml --loss square=1", ["tuning.loss.square", "position"]),
    "negative loss": ("tune tiny.toml --loss position=-1", ["--loss", "'position=-1'"]),
    "tune a baseline": ("tune tiny.toml --system taylor-ls", ["taylor-ls", "baseline"]),
    "nothing to resume": ("tune tiny.toml --out a.json --resume", ["a.state.pt", "resume"]),
    "out of tune": ("tune tiny.toml --out a.txt", ["a.txt", ".json"]),
    "out of compare": ("compare tiny.toml --out a.csv", ["a.csv", ".json or .md"]),
    "unknown system": ("compare tiny.toml --system ekff", ["'ekff'", "chan-ekf"]),
    "unknown values": ("compare tiny.toml --values best", ["'best'", "published"]),
    "no tuned values": (
        "compare gate-lockout --values tuned", ["gate-lockout", "difffilter tune"],
    ),
    "values of another system": (
        "compare tiny.toml --system ekf --values frozen.json", ["frozen.json", "m-ekf", "ekf"],
    ),
    "values of another world": (
        "compare uwb-ranges --values frozen.json --log log.csv", ["frozen.json", "m-ekf", "robust"],
    ),
    "log and trajectories": (
        "compare tiny.toml --log log.csv --trajectories 3", ["--trajectories", "--log"],
    ),
    "compare clairvoyant on a log": (
        "compare tiny.toml --log log.csv --system clairvoyant", ["clairvoyant", "fault"],
    ),
    "run clairvoyant on a log": (
        "run tiny.toml log.csv --out a.csv --system clairvoyant", ["clairvoyant", "fault"],
    ),
    "no out": ("run frozen.json log.csv", ["--out"]),
    "out is the log": ("run frozen.json log.csv --out ./log.csv", ["log.csv", "the log itself"]),
    "out is a folder": ("run frozen.json log.csv --out .", ["folder"]),
    "no log": ("run frozen.json no.csv --out a.csv", ["no.csv"]),
    "no checkpoint": ("run no.json log.csv --out a.csv", ["no.json"]),
    "other system": ("run frozen.json log.csv --system ekf --out a.csv", ["m-ekf", "ekf"]),
    "unknown run": ("run frozen.json log.csv --run los --out a.csv", ["--run", "'los'"]),
    "log of another scenario": ("run uwb-ranges log.csv --out a.csv", ["tdoa_2", "range_a3"]),
}  # fmt: skip


@pytest.mark.parametrize("name", ARGUMENTS)
def test_arguments(place: Path, capsys: Any, name: str) -> None:
    arguments, needles = ARGUMENTS[name]
    before = {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}
    line = fails(capsys, *arguments.split())
    for needle in needles:
        assert needle in line
    assert before == {path: path.read_bytes() for path in place.rglob("*") if path.is_file()}


def _field(row: int, column: int, text: str) -> Callable[[list[list[str]]], None]:
    def change(lines: list[list[str]]) -> None:
        lines[row][column] = text

    return change


#: How log.csv is spoiled (row 0 is the header, line 1 of the file), and what must be named.
LOGS: dict[str, tuple[Callable[[list[list[str]]], object], list[str]]] = {
    "unknown channel": (_field(0, 3, "tdoa_9"), ["line 1", "'tdoa_4'"]),
    "extra column": (lambda rows: [r.append("1") for r in rows], ["line 1", "'1'", "truth_"]),
    "channel missing": (lambda rows: [r.pop(2) for r in rows], ["line 1", "'tdoa_3'"]),
    "text in a number": (_field(4, 2, "12,5".replace(",", ";")), ["line 5", "tdoa_3", "'12;5'"]),
    "not finite": (_field(4, 2, "inf"), ["line 5", "tdoa_3", "'inf'"]),
    "time goes back": (_field(6, 0, "0.2"), ["line 7", "time", "0.2 after 0.5"]),
    "time missing": (_field(6, 0, ""), ["line 7", "time"]),
    "row cut off": (lambda rows: rows[-1].pop(), ["line 21", "11 fields", "12"]),
    "no rows": (lambda rows: rows.__delitem__(slice(1, None)), ["header"]),
    "empty": (lambda rows: rows.clear(), ["empty"]),
}


@pytest.mark.parametrize("name", LOGS)
def test_spoiled_log(place: Path, capsys: Any, name: str) -> None:
    """Every command that reads logs says the same; an older result stays as it was."""
    spoil, needles = LOGS[name]
    rows = [line.split(",") for line in Path("log.csv").read_text().splitlines()]
    spoil(rows)
    Path("log.csv").write_text("".join(",".join(row) + "\n" for row in rows))
    Path("out.csv").write_text("older")
    lines = {
        fails(capsys, "run", "frozen.json", "log.csv", "--out", "out.csv"),
        fails(capsys, "compare", "tiny.toml", "--log", "log.csv"),
        fails(capsys, "tune", "tiny.toml", "--log", "log.csv", "--out", "new.json"),
    }
    assert len(lines) == 1
    for needle in ["log.csv", *needles]:
        assert needle in lines.copy().pop()
    assert Path("out.csv").read_text() == "older"
    assert not Path("new.json").exists()


def _value(text: str) -> Callable[[str], str]:
    def change(content: str) -> str:
        data = json.loads(content)
        data["parameters"]["tdoa.sigma"]["value"] = "HERE"
        return json.dumps(data).replace('"HERE"', text)

    return change


def _key(name: str, value: Any) -> Callable[[str], str]:
    return lambda content: json.dumps(json.loads(content) | {name: value})


#: How frozen.json is spoiled, and what must be named.
CHECKPOINTS: dict[str, tuple[Callable[[str], str], list[str]]] = {
    "truncated": (lambda content: content[: len(content) // 2], ["truncated", "line"]),
    "empty": (lambda content: "", ["damaged"]),
    "not JSON": (lambda content: "schema = 1", ["damaged"]),
    "NaN": (_value("NaN"), ["NaN"]),
    "infinite": (_value("1e999"), ["finite number"]),
    "negative sigma": (_value("-1.0"), ["tdoa.sigma", "-1.0"]),
    "wrong shape": (_value("[1.0, 2.0]"), ["tdoa.sigma", "[2]"]),
    "text": (_value('"3.0"'), ["tdoa.sigma", "'3.0'"]),
    "format": (_key("format", "other"), ["format", "'other'"]),
    "version": (_key("version", 99), ["version", "99"]),
    "extra key": (_key("extra", 1), ["extra"]),
    "baseline": (_key("system", "taylor-ls"), ["'taylor-ls'", "a filter"]),
}


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_spoiled_checkpoint(place: Path, capsys: Any, name: str) -> None:
    spoil, needles = CHECKPOINTS[name]
    Path("frozen.json").write_text(spoil(Path("frozen.json").read_text()))
    Path("out.csv").write_text("older")
    line = fails(capsys, "run", "frozen.json", "log.csv", "--out", "out.csv")
    assert line == fails(capsys, "compare", "tiny.toml", "--values", "frozen.json")
    for needle in ["frozen.json", *needles]:
        assert needle in line
    assert Path("out.csv").read_text() == "older"


@pytest.mark.parametrize(
    ("arguments", "needle"),
    [
        ("show airport-mlatt", "did you mean airport-mlat?"),
        ("tune tiny.toml --steps 0", "--steps"),
        ("run frozen.json tiny.toml --out a.csv", "tiny.toml"),
        ("compare tiny.toml --set world.steps=0 --json", "world.steps"),
    ],
)
def test_in_a_process(place: Path, arguments: str, needle: str) -> None:
    """As a user meets it: no traceback, no warning of a library beside the line."""
    done = process(*arguments.split(), cwd=place)
    check_failure(done.returncode, done.stdout, done.stderr)
    assert needle in done.stderr


def test_what_is_tuned_by_errors_needs_truth(place: Path, capsys: Any) -> None:
    lines = Path("log.csv").read_text().splitlines()
    Path("log.csv").write_text("".join(",".join(li.split(",")[:8]) + "\n" for li in lines))
    assert "truth" in fails(capsys, "compare", "tiny.toml", "--log", "log.csv", "--states")
    assert "truth" in fails(capsys, "tune", "tiny.toml", "--log", "log.csv", "--out", "a.json")
