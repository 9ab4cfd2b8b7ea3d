"""JSON as checkpoints are read: finite numbers, no key twice, every table with its keys alone."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

from difffilter.errors import CheckpointError, shown
from difffilter.parameters.parameters import Number

__all__ = ["numbers", "read_json", "same_keys"]


def read_json(path: Path) -> Any:
    """What the file holds; every fault is a CheckpointError that names the file."""

    def no_constant(text: str) -> NoReturn:
        raise ValueError(f"found {text}, expected finite numbers")

    def finite(text: str) -> float:
        value = float(text)
        if not math.isfinite(value):
            no_constant(text)
        return value

    def once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(pairs)
        if len(found) < len(pairs):
            keys = [key for key, _ in pairs]
            twice = next(key for key in keys if keys.count(key) > 1)
            raise ValueError(f"found the key {shown(twice)} twice, expected it once")
        return found

    def whole(text: str) -> int:
        finite(text)
        return int(text)

    try:
        return json.loads(
            path.read_text(encoding="utf-8"),
            parse_constant=no_constant,
            parse_float=finite,
            parse_int=whole,
            object_pairs_hook=once,
        )
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read: {error.strerror}") from None
    except json.JSONDecodeError as error:
        raise CheckpointError(
            f"{path}, line {error.lineno}: damaged or truncated JSON: {error.msg}"
        ) from None
    except (UnicodeDecodeError, ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: {error}") from None


def same_keys(path: Path, where: str, table: Mapping[str, Any], expected: set[str]) -> None:
    """CheckpointError that names the first key of a table that is missing or too many."""
    prefix = f"{where}." if where else ""
    for key in sorted(expected - set(table)):
        raise CheckpointError(f"{path}: {prefix}{key}: found nothing, expected this key")
    for key in sorted(set(table) - expected):
        raise CheckpointError(f"{path}: {prefix}{key}: unknown key, expected no such key")


def numbers(value: Any) -> Number:
    """Nested lists of true numbers (no text, no booleans)."""
    if isinstance(value, list):
        return tuple(numbers(item) for item in value)  # type: ignore[return-value]
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"found {shown(value)}, expected a finite number")
    return float(value)
