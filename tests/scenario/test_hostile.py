"""Scenario files and checkpoints that nobody wrote by hand: one line each, exit code 2."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from difffilter import Checkpoint, load, load_scenario, save
from difffilter.cli.main import main
from difffilter.errors import CheckpointError, InputError, shown
from difffilter.scenario.document import DEPTH, check_texts

START = 'schema = 1\nextends = "airport-mlat"\n'
LONG = "9" * 5000


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]):  # type: ignore[no-untyped-def]
    """The one line with which a command refuses a file."""

    def run(text: str, *command: str) -> str:
        path = tmp_path / "hostile.toml"
        path.write_text(text, encoding="utf-8")
        code = main([*(command or ("show",)), str(path)])
        out, err = capsys.readouterr()
        assert (code, out) == (2, "")
        assert err.count("\n") == 1
        assert len(err) < 1000
        assert "hostile.toml" in err
        assert err.isprintable() or err[:-1].isprintable()
        return err

    return run


TEXTS = [
    ("a = " + "[" * 3000 + "]" * 3000, "not valid TOML: nested too deep"),
    (f"a = {LONG}", "not valid TOML: Exceeds the limit"),
    ("a = " + "[" * 100 + "]" * 100, f"found more than {DEPTH} levels"),
    ('name = "\\ud800"', "not valid TOML"),
    ('name = "../../evil"', r"name: found '../../evil', expected a name: a letter"),
    ('name = "/tmp/evil"', "name: found '/tmp/evil', expected a name"),
    ('name = "C:evil"', "name: found 'C:evil', expected a name"),
    ('title = "\\u001b[2J"', "control characters"),
    ('"a\\u001bb" = 1', "control characters"),
    (f'name = "{"n" * 100_000}"', "name: found 'nnnn"),
    (f'"{"k" * 100_000}" = 1', "unknown key"),
    (
        "[world]\nsteps = 10000000000000000000000",
        "of 1 or more and at most",
    ),
    ('[sensors."*/ x"]\nkind = "position"', "found no name, expected a name"),
    ('[sensors."a/b"]\nkind = "position"', "found no name, expected a name"),
    (
        '[sensors.pos]\nkind = "position"\nchannels = ["a b", "*/"]',
        "with names, not 'a b'",
    ),
    ('[faults."../x"]\nkind = "dropout"', "found no name"),
    ('[systems."x\\ny"]\nweight = "huber"', "found no name"),
    ('[[worlds]]\nname = "a b"\n[worlds.overrides]\n"world.steps" = 3', "expected a name"),
]


@pytest.mark.parametrize(("text", "message"), TEXTS, ids=range(len(TEXTS)))
def test_a_hostile_scenario_is_refused_in_one_line(refused: Any, text: str, message: str) -> None:
    assert message in refused(START + text)


@pytest.mark.parametrize(
    "text",
    [
        "[world]\ndt = 1e308",
        "[world]\nvelocity = [1e308, 1e308]",
        "[world]\nposition = [1e308, 1e308]",
    ],
)
def test_a_world_beyond_numbers_is_refused_in_one_line(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "far.toml"
    path.write_text(START + text, encoding="utf-8")
    command = ["simulate", str(path), "--trajectories", "2", "--out", str(tmp_path / "logs")]
    assert main(command) == 2
    err = capsys.readouterr().err
    assert err.count("\n") == 1
    assert "Traceback" not in err
    assert not list(tmp_path.glob("logs/*"))


def test_a_byte_order_mark_is_no_part_of_a_scenario(tmp_path: Path) -> None:
    path = tmp_path / "marked.toml"
    path.write_text(START + 'name = "marked"\n', encoding="utf-8-sig")
    assert load_scenario(path).name == "marked"


def test_names_may_be_of_any_script(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(START + 'name = "Überflug-测试_1"\n', encoding="utf-8")
    assert load_scenario(path).name == "Überflug-测试_1"


def test_a_key_twice_in_a_checkpoint_is_refused(tmp_path: Path) -> None:
    scenario = load_scenario("airport-mlat")
    path = tmp_path / "mine.json"
    save(Checkpoint(scenario, "ekf", scenario.system("ekf").published()), path)
    load(path)
    text = path.read_text(encoding="utf-8")
    assert '"temperature": null' in text
    path.write_text(text.replace('"temperature": null', '"temperature": 1, "temperature": null'))
    with pytest.raises(CheckpointError, match=r"mine\.json: found the key 'temperature' twice"):
        load(path)


@pytest.mark.parametrize("name", ["../../evil", "\ud800", "a\x1b[2J", "a" * 10**6])
def test_a_checkpoints_document_is_read_as_strictly(name: str, tmp_path: Path) -> None:
    scenario = load_scenario("airport-mlat")
    path = tmp_path / "mine.json"
    save(Checkpoint(scenario, "ekf", scenario.system("ekf").published()), path)
    data = json.loads(path.read_text(encoding="utf-8"))
    data["document"]["name"] = data["scenario"] = name
    path.write_text(json.dumps(data), encoding="utf-8")
    with pytest.raises(CheckpointError, match=r"mine\.json") as caught:
        load(path)
    assert len(str(caught.value)) < 500
    assert str(caught.value).isprintable()


def test_what_was_found_is_shown_with_a_limit() -> None:
    assert shown("abc") == "'abc'"
    assert len(shown("x" * 10**6)) == 83
    assert len(shown(list(range(10**5)))) == 83
    assert shown(10**5000) == "a whole number of too many digits"
    assert shown([10**5000]) == "a list of too many digits"
    deep: list[Any] = []
    for _ in range(100_000):
        deep = [deep]
    assert shown(deep) == "what is nested too deep"
    with pytest.raises(InputError, match="levels"):
        check_texts({"a": deep}, "here")
    while deep:  # take it apart: Python's own deallocation would recurse
        deep = deep[0]
