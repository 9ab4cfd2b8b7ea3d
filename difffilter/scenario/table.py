"""A TOML table that checks what is read from it and names every wrong key."""

from __future__ import annotations

import difflib
import math
import re
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

from difffilter.errors import InputError, shown
from difffilter.registry import NAME

__all__ = ["LABEL", "MEASURES", "Table"]

_REQUIRED = object()
#: Keys that messages show as they are.
PLAIN = re.compile(r"[\w.*-]{1,120}")
#: Whole numbers beyond it count nothing that a computer can hold.
LARGEST = 2**31 - 1
#: What a name is, for messages.
LABEL = "a name: a letter, then letters, digits, _ and -, at most 64"

#: Factor to the SI unit of a measurement, by that unit and by the name in a scenario file.
MEASURES = {
    "m": {"m": 1.0, "km": 1e3, "cm": 1e-2, "us": 299.792458, "ns": 0.299792458},
    "rad": {"rad": 1.0, "mrad": 1e-3, "deg": math.pi / 180.0},
    "rad/s": {"rad/s": 1.0, "mrad/s": 1e-3, "deg/s": math.pi / 180.0},
}


class Table:
    """One table of a scenario file: every key is read once, with its expected form.

    Args:
        data: the parsed table.
        where: file name, for messages.
        path: dotted path of the table in the file; "" for the top.
    """

    def __init__(self, data: dict[str, Any], where: str, path: str = "") -> None:
        self.data, self.where, self.path = data, where, path
        self._read: set[str] = set()

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def name(self, key: str) -> str:
        """Dotted path of a key; a key that is no name as text, for messages."""
        key = key if PLAIN.fullmatch(key) else shown(key)
        return f"{self.path}.{key}" if self.path else key

    def fail(self, key: str, expected: str) -> NoReturn:
        """Raise InputError for a key: file, key, what was found, what was expected."""
        found = shown(self.data[key]) if key in self.data else "nothing"
        raise InputError(f"{self.where}: {self.name(key)}: found {found}, expected {expected}")

    def take(self, key: str, expected: str, default: Any = _REQUIRED) -> Any:
        """The raw value of a key, marked as read."""
        self._read.add(key)
        if key not in self.data:
            if default is _REQUIRED:
                self.fail(key, expected)
            return default
        return self.data[key]

    def text(self, key: str, default: Any = _REQUIRED, choices: Sequence[str] = ()) -> str:
        """A string, one of ``choices`` where given."""
        expected = f"one of {', '.join(choices)}" if choices else "a text"
        value = self.take(key, expected, default)
        if value is not default and (
            not isinstance(value, str) or (choices and value not in choices)
        ):
            self.fail(key, expected)
        return value  # type: ignore[no-any-return]

    def label(self, key: str) -> str:
        """A name: text of the form that :data:`difffilter.registry.NAME` says."""
        value = self.text(key)
        if not NAME.fullmatch(value):
            self.fail(key, LABEL)
        return value

    def flag(self, key: str, default: bool = False) -> bool:
        """true or false."""
        value = self.take(key, "true or false", default)
        if not isinstance(value, bool):
            self.fail(key, "true or false")
        return value

    def number(
        self,
        key: str,
        default: Any = _REQUIRED,
        low: float = -math.inf,
        high: float = math.inf,
        above: float = -math.inf,
    ) -> float:
        """A finite number in [low, high], and above ``above``."""
        expected = "a number"
        if above > -math.inf:
            expected += f" above {above:g}"
        if low > -math.inf:
            expected += f" of {low:g} or more"
        if high < math.inf:
            expected += f" and at most {high:g}"
        value = self.take(key, expected, default)
        if value is default:
            return value  # type: ignore[no-any-return]
        if not _is_number(value) or not low <= value <= high or value <= above:
            self.fail(key, expected)
        return float(value)

    def integer(self, key: str, default: Any = _REQUIRED, low: int = 0, high: int = LARGEST) -> int:
        """A whole number of at least ``low`` and at most ``high``."""
        expected = f"a whole number of {low} or more"
        if key in self.data and isinstance(self.data[key], int) and self.data[key] > high:
            expected += f" and at most {high}"
        value = self.take(key, expected, default)
        if value is default:
            return value  # type: ignore[no-any-return]
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            self.fail(key, expected)
        return value

    def numbers(
        self, key: str, count: int | None = None, default: Any = _REQUIRED
    ) -> tuple[float, ...]:
        """A list of finite numbers, ``count`` of them where given."""
        expected = f"a list of {count} numbers" if count else "a list of numbers"
        value = self.take(key, expected, default)
        if value is default:
            return value  # type: ignore[no-any-return]
        if not isinstance(value, list) or (count is not None and len(value) != count):
            self.fail(key, expected)
        if not all(_is_number(item) for item in value):
            self.fail(key, expected)
        return tuple(float(item) for item in value)

    def nested(self, key: str, default: Any = _REQUIRED) -> Any:
        """A number, a list of numbers, or a list of lists, as nested tuples."""
        expected = "a number, a list of numbers or a matrix"
        value = self.take(key, expected, default)
        if value is default:
            return value

        def convert(item: Any) -> Any:
            if isinstance(item, list) and item:
                rows = tuple(convert(inner) for inner in item)
                if len({len(row) if isinstance(row, tuple) else 0 for row in rows}) > 1:
                    self.fail(key, expected)
                return rows
            if not _is_number(item):
                self.fail(key, expected)
            return float(item)

        return convert(value)

    def points(self, key: str) -> tuple[tuple[float, ...], ...]:
        """A list of points with the same number of coordinates."""
        value = self.nested(key)
        if not (
            isinstance(value, tuple)
            and all(isinstance(point, tuple) for point in value)
            and all(isinstance(number, float) for point in value for number in point)
        ):
            self.fail(key, "a list of points, each a list of numbers")
        return value

    def names(self, key: str, default: Any = _REQUIRED) -> tuple[str, ...]:
        """A list of texts."""
        value = self.take(key, "a list of texts", default)
        if value is default:
            return value  # type: ignore[no-any-return]
        if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
            self.fail(key, "a list of texts")
        return tuple(value)

    def unit(self, base: str = "m", sigma: float | None = None) -> float:
        """Factor of the table's ``unit`` to ``base``, m (ns and us: light travel time) or rad.

        Where ``sigma`` is given, the unit may be ``sigma``: so many standard deviations.
        """
        units = MEASURES.get(base, {base: 1.0}) | ({} if sigma is None else {"sigma": sigma})
        return units[self.text("unit", base, choices=tuple(units))]

    def table(self, key: str, optional: bool = False) -> Table:
        """A sub-table; an empty one if optional and absent."""
        value = self.take(key, "a table", {} if optional else _REQUIRED)
        if not isinstance(value, dict):
            self.fail(key, "a table")
        return Table(value, self.where, self.name(key))

    def tables(self, key: str) -> list[Table]:
        """An array of tables; empty if absent."""
        value = self.take(key, "an array of tables", [])
        if not isinstance(value, list) or not all(isinstance(item, dict) for item in value):
            self.fail(key, "an array of tables")
        return [Table(item, self.where, f"{self.name(key)}[{i}]") for i, item in enumerate(value)]

    def named(self) -> list[tuple[str, Table]]:
        """Every key as a named sub-table; InputError for a key that is no name."""
        for key in self.data:
            if not NAME.fullmatch(key):
                raise InputError(f"{self.where}: {self.name(key)}: found no name, expected {LABEL}")
        return self.children()

    def children(self) -> list[tuple[str, Table]]:
        """Every key as a named sub-table."""
        return [(key, self.table(key)) for key in self.data]

    def finish(self) -> None:
        """Raise InputError for a key that nobody read."""
        for key in self.data:
            if key not in self._read:
                close = difflib.get_close_matches(key, self._read, n=1)
                hint = (
                    f"did you mean {close[0]!r}?"
                    if close
                    else (f"expected one of {', '.join(sorted(self._read))}")
                )
                raise InputError(f"{self.where}: {self.name(key)}: unknown key, {hint}")


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return False
    return abs(value) <= sys.float_info.max  # false for NaN; whole numbers can be larger
