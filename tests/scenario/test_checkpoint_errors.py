"""Checkpoint files that are damaged, edited or of another version: refused by file and key."""

from __future__ import annotations

import copy
import json
import re
from pathlib import Path
from typing import Any

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from difffilter.errors import CheckpointError
from difffilter.filters.recipe import Recipe
from difffilter.scenario.checkpoint import Checkpoint, load, save
from difffilter.scenario.scenario import load_scenario


@pytest.fixture(scope="module")
def text(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A sound file."""
    scenario = load_scenario("airport-mlat")
    filter = scenario.system("m-ekf")
    assert isinstance(filter, Recipe)
    path = tmp_path_factory.mktemp("sound") / "x.json"
    save(Checkpoint(scenario, "m-ekf", filter.published()), path)
    return path.read_text()


def refused(tmp_path: Path, content: str | bytes) -> str:
    path = tmp_path / "x.json"
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(CheckpointError) as caught:
        load(path)
    message = str(caught.value)
    assert "x.json" in message
    assert "\n" not in message
    return message


REMOVED = object()
P = "parameters.tdoa.sigma"
#: Path in the file (| between keys), what is put there, the key that must be named, and more.
SPOILED: list[tuple[str, Any, str, str]] = [
    ("format", "pickle", "format", "found 'pickle', expected 'difffilter-checkpoint'"),
    ("format", REMOVED, "format", "found None"),
    ("version", 2, "version", "found 2, expected 1"),
    ("version", 1.0, "version", "found 1.0"),
    ("version", True, "version", "found True"),
    ("version", "1", "version", "found '1', expected 1"),
    ("comment", "hello", "comment", "unknown key"),
    ("parameters", [], "parameters", "found []"),
    ("training", None, "training", "found None"),
    ("temperature", "cold", "temperature", "found 'cold'"),
    ("temperature", 0.0, "temperature", "expected null or a number above 0"),
    ("temperature", -1, "temperature", "expected null or a number above 0"),
    ("temperature", True, "temperature", "found True"),
    ("git_commit", 5, "git_commit", "found 5"),
    ("scenario", "airport", "scenario", "found 'airport', expected 'airport-mlat'"),
    ("system", "ukf", "system", "found 'ukf', expected one of taylor-ls"),
    ("system", "chan-ls", "system", "found 'chan-ls', expected a filter"),
    ("system", "ekf", "parameters.tanh.ab", "unknown key"),
    ("parameters|tdoa.sigma", REMOVED, P, "found nothing, expected this key"),
    ("parameters|imq.k", {"value": 1.0}, "parameters.imq.k", "unknown key"),
    ("parameters|tdoa.sigma", 3.0, P, "found 3.0, expected a table"),
    ("parameters|tdoa.sigma|value", REMOVED, f"{P}.value", "found nothing"),
    ("parameters|tdoa.sigma|colour", "red", f"{P}.colour", "unknown key"),
    ("parameters|tdoa.sigma|value", -1.0, f"{P}.value", "expected a number above 0"),
    ("parameters|tdoa.sigma|value", 0, f"{P}.value", "expected a number above 0"),
    ("parameters|tdoa.sigma|value", "3.0", f"{P}.value", "found '3.0', expected a finite number"),
    ("parameters|tdoa.sigma|value", True, f"{P}.value", "found True, expected a finite number"),
    ("parameters|tdoa.sigma|value", None, f"{P}.value", "found None, expected a finite number"),
    ("parameters|tdoa.sigma|value", [3.0], f"{P}.value", "found shape [1], expected []"),
    ("parameters|tdoa.sigma|value", {"a": 1}, f"{P}.value", "expected a finite number"),
    ("parameters|tanh.ab|value", [4.0, 1.5], "parameters.tanh.ab.value", "0 < a < b"),
    ("parameters|tanh.ab|value", [[1.5], [4.0, 1]], "parameters.tanh.ab.value", ""),
    ("parameters|tanh.ab|value", [1.5, "4"], "parameters.tanh.ab.value", "found '4'"),
    ("parameters|tanh.ab|value", [], "parameters.tanh.ab.value", "found shape [0]"),
    ("parameters|prior.floor", {}, "parameters.prior.floor", "unknown key"),
    ("parameters|tdoa.sigma|published", 3.1, f"{P}.published", "as in the stored document"),
    ("parameters|tdoa.sigma|unit", "ns", f"{P}.unit", "found 'ns', expected 'm'"),
    ("parameters|tdoa.sigma|source", "me", f"{P}.source", "found 'me'"),
    ("parameters|tdoa.sigma|tuned", False, f"{P}.tuned", "found False, expected True"),
    ("recipe|weight", "huber", "recipe.weight", "found 'huber', expected 'tanh'"),
    ("recipe|extra", 1, "recipe.extra", "unknown key"),
    ("document|systems|m-ekf|weight", "huber", "parameters.huber.k", "found nothing"),
    ("document|systems|m-ekf|iterations", 4, "recipe.iterations", "found 5, expected 4"),
    ("document|parameters|tdoa|sigma|value", 11.0, f"{P}.published", "as in the stored docum"),
    ("document|schema", 9, "schema", "found 9, expected 1"),
    ("document|world|stps", 3, "world.stps", "did you mean 'steps'?"),
    ("document|name", "other", "scenario", "expected 'other'"),
]  # fmt: skip


@pytest.mark.parametrize(("where", "value", "key", "more"), SPOILED)
def test_an_edited_file_is_refused_by_key(
    tmp_path: Path, text: str, where: str, value: Any, key: str, more: str
) -> None:
    data: Any = json.loads(text)
    table = data
    *parents, last = where.split("|")
    for parent in parents:
        table = table[parent]
    if value is REMOVED:
        del table[last]
    else:
        table[last] = value
    message = refused(tmp_path, json.dumps(data))
    assert f": {key}" in message
    assert more in message


@pytest.mark.parametrize("keys", [("scope", "distance", "recovery"), ("recovery",)])
def test_a_file_from_before_some_keys_of_the_recipe_still_loads(
    tmp_path: Path, text: str, keys: tuple[str, ...]
) -> None:
    data = json.loads(text)
    for key in keys:
        del data["recipe"][key]
    path = tmp_path / "x.json"
    path.write_text(json.dumps(data))
    found = load(path)
    assert found.published_filter == load_scenario("airport-mlat").system("m-ekf")
    assert found.as_dict()["recipe"] == json.loads(text)["recipe"]


@pytest.mark.parametrize(
    ("key", "value"), [("scope", "all"), ("distance", "mahalanobis"), ("recovery", "widen")]
)
def test_newer_keys_of_the_recipe_are_checked_where_they_stand(
    tmp_path: Path, text: str, key: str, value: str
) -> None:
    data = json.loads(text)
    data["recipe"][key] = value
    assert f": recipe.{key}: found {value!r}, expected " in refused(tmp_path, json.dumps(data))


def test_every_key_of_the_top_is_needed(tmp_path: Path, text: str) -> None:
    data = json.loads(text)
    for key in data:
        less = copy.copy(data)
        del less[key]
        assert f"x.json: {key}: found " in refused(tmp_path, json.dumps(less))


NUMBER = re.compile(r'("tdoa.sigma": \{\s*"value": )[^,]*')


@pytest.mark.parametrize(
    "token", ["NaN", "Infinity", "-Infinity", "1e999", "-1e999", "1" + "0" * 400, "1" + "0" * 5000]
)
def test_numbers_that_are_not_finite_are_refused(tmp_path: Path, text: str, token: str) -> None:
    spoiled, count = NUMBER.subn(lambda match: match[1] + token, text)
    assert count == 1
    refused(tmp_path, spoiled)
    for key in ('"temperature": null', '"training": {}'):
        assert key in text
        name = key.split(":")[0]
        value = f'{{"loss": {token}}}' if "training" in key else token
        refused(tmp_path, text.replace(key, f"{name}: {value}"))


@pytest.mark.parametrize(
    "content",
    [
        b"", b"null", b"[]", b"3", b'"text"', b"{", b"{}", b"not json", b"\xff\xfe\x00",
        b"\x80\x04\x95", b"[" * 100000, b'{"format": "difffilter-checkpoint"}',
        b'{"format": "difffilter-checkpoint", "version": 1}',
    ],
)  # fmt: skip
def test_other_content_is_refused(tmp_path: Path, content: bytes) -> None:
    refused(tmp_path, content)


def test_a_torch_file_is_refused_unread(tmp_path: Path) -> None:
    torch.save({"format": "difffilter-checkpoint"}, tmp_path / "y.pt")
    refused(tmp_path, (tmp_path / "y.pt").read_bytes())


def test_a_missing_file_and_a_folder_are_refused_by_name(tmp_path: Path) -> None:
    for path in (tmp_path / "none.json", tmp_path):
        with pytest.raises(CheckpointError, match=f"{re.escape(str(path))}: cannot be read"):
            load(path)


def test_malformed_json_is_refused_by_line(tmp_path: Path, text: str) -> None:
    lines = text.splitlines()
    lines[6] = lines[6].replace(":", ";", 1)
    assert "x.json, line 7: damaged or truncated JSON" in refused(tmp_path, "\n".join(lines))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0))
def test_a_file_cut_anywhere_is_refused(tmp_path: Path, text: str, share: float) -> None:
    end = text.rindex("}")
    message = refused(tmp_path, text[: int(share * end)])
    assert "damaged or truncated JSON" in message


@settings(max_examples=150, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(share=st.floats(0.0, 1.0, exclude_max=True), byte=st.integers(0, 255))
def test_a_changed_byte_is_refused_or_leaves_an_admissible_file(
    tmp_path: Path, text: str, share: float, byte: int
) -> None:
    content = bytearray(text.encode())
    content[int(share * len(content))] = byte
    path = tmp_path / "x.json"
    path.write_bytes(content)
    try:
        found = load(path)
    except CheckpointError as error:
        message = str(error)
    else:
        message = "x.json"
        for name, parameter in found.published_filter.declarations.items():
            parameter.check(found.values[name])
    assert "x.json" in message
