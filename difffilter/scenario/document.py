"""Scenario files: find, read, inherit, override."""

from __future__ import annotations

import copy
import difflib
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from difffilter.errors import InputError, shown
from difffilter.files import data_folder

__all__ = [
    "SCHEMA",
    "ancestors",
    "apply_overrides",
    "check_texts",
    "parse_override",
    "read_document",
    "scenario_names",
]

#: Version of the scenario schema that this library reads.
SCHEMA = 1
#: Levels of tables and lists at most.
DEPTH = 32
#: The keys of a dotted path; one in quotes may have dots itself.
KEYS = re.compile(r'"[^"]*"|[^.]+')
#: Control characters but tabs and line ends, and halves of surrogate pairs.
CONTROL = re.compile("[\x00-\x08\x0b\x0c\x0e-\x1f\x7f-\x9f\ud800-\udfff]")


def scenario_names() -> list[str]:
    """Names of the scenarios that come with the package."""
    return sorted(path.stem for path in data_folder("scenarios").glob("*.toml"))


def find_document(name: str | Path) -> Path:
    """Path of a scenario by name, or of the user's own .toml file."""
    path = Path(name)
    if path.suffix == ".toml":
        if not path.is_file():
            raise InputError(f"{path}: found no such file, expected a scenario file")
        return path
    path = data_folder("scenarios") / f"{name}.toml"
    if not path.is_file():
        known = scenario_names()
        close = difflib.get_close_matches(str(name), known, n=1)
        hint = f"; did you mean {close[0]}?" if close else ""
        raise InputError(
            f"scenario: found {shown(str(name))}, expected one of {', '.join(known)} "
            f"or a path to a .toml file{hint}"
        )
    return path


def read_document(name: str | Path) -> tuple[dict[str, Any], Path]:
    """The parsed scenario with everything that it inherits merged in, and its path.

    Raises:
        InputError: no such scenario, unreadable or malformed TOML, a wrong schema version,
            or an ``extends`` that goes round in a circle.
    """
    path = find_document(name)
    seen: list[Path] = []
    layers: list[dict[str, Any]] = []
    current: Path | None = path
    while current is not None:
        if current.resolve() in seen:
            raise InputError(f"{path}: extends: found a circle, expected a chain of files")
        seen.append(current.resolve())
        layer = _parse(current)
        layers.append(layer)
        parent = layer.pop("extends", None)
        if parent is None:
            current = None
        elif not isinstance(parent, str):
            raise InputError(
                f"{current}: extends: found {shown(parent)}, expected a name or a path"
            )
        else:
            current = _parent(current, parent)
    merged: dict[str, Any] = {}
    for layer in reversed(layers):
        merged = _merge(merged, layer)
    return merged, path


def ancestors(path: Path) -> list[str]:
    """Names of the scenarios that a file extends, the nearest first; none of no file."""
    found: list[str] = []
    while path.is_file() and len(found) < DEPTH:
        layer = _parse(path)
        if found or "extends" in layer:
            found.append(str(layer.get("name", path.stem)))
        if "extends" not in layer:
            break
        path = _parent(path, str(layer["extends"]))
    return found[1:]


def _parent(child: Path, name: str) -> Path:
    if name.endswith(".toml"):
        return find_document(child.parent / name)
    return find_document(name)


def _parse(path: Path) -> dict[str, Any]:
    try:
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read: {error}") from None
    data = _toml(text, str(path))
    if data.get("schema") != SCHEMA:
        raise InputError(f"{path}: schema: found {shown(data.get('schema'))}, expected {SCHEMA}")
    return data


def _toml(text: str, where: str) -> dict[str, Any]:
    """Parsed TOML; InputError where it is none, or beyond the parser."""
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise InputError(f"{where}: not valid TOML: nested too deep") from None
    except ValueError as error:  # not TOML, or a whole number of too many digits
        reason = str(error).split(";")[0]
        raise InputError(f"{where}: not valid TOML: {shown(reason, 300)[1:-1]}") from None


def check_texts(document: Mapping[str, Any], where: str) -> None:
    """Refuse what no scenario needs: deep nesting, and characters that control a terminal.

    Raises:
        InputError: more than ``DEPTH`` levels; a key or a text with a control character or
            half a surrogate pair.
    """
    layer: list[Any] = [document]
    for _ in range(DEPTH):
        inner: list[Any] = []
        for item in layer:
            if isinstance(item, Mapping):
                inner += [*item.keys(), *item.values()]
            elif isinstance(item, list):
                inner += item
            elif isinstance(item, str) and CONTROL.search(item):
                raise InputError(
                    f"{where}: found the text {shown(item)}, expected no control characters"
                )
        layer = inner
        if not layer:
            return
    raise InputError(f"{where}: found more than {DEPTH} levels, expected tables less deep")


def _merge(base: Mapping[str, Any], layer: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in layer.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict):
            merged[key] = _merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def parse_override(text: str) -> tuple[str, Any]:
    """``key.path=value`` to the path and the value, read as TOML (else as plain text)."""
    key, separator, value = text.partition("=")
    key = key.strip()
    if not separator or not key:
        raise InputError(f"--set: found {shown(text)}, expected key.path=value")
    try:
        return key, _toml(f"value = {value.strip()}", "--set")["value"]
    except InputError:
        return key, value.strip()


def apply_overrides(document: dict[str, Any], overrides: Mapping[str, Any]) -> dict[str, Any]:
    """A copy of the document with each dotted path set; the schema checks the result."""
    result = copy.deepcopy(document)
    for path, value in overrides.items():
        table: Any = result
        keys = [key.strip('"') for key in KEYS.findall(path)] or [path]
        for i, key in enumerate(keys[:-1]):
            table = _enter(table, key, ".".join(keys[: i + 1]))
        if isinstance(table, list):
            _enter(table, keys[-1], path)
            table[int(keys[-1])] = value
        elif isinstance(table, dict):
            table[keys[-1]] = value
        else:
            raise InputError(f"{path}: found a value at its parent, expected a table")
    return result


def _enter(table: Any, key: str, path: str) -> Any:
    if isinstance(table, list):
        if not key.isdecimal() or int(key) >= len(table):
            raise InputError(f"{path}: found index {key!r}, expected 0 to {len(table) - 1}")
        return table[int(key)]
    if not isinstance(table, dict):
        raise InputError(f"{path}: found a value at its parent, expected a table")
    return table.setdefault(key, {})
