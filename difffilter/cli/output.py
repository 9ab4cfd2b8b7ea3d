"""What commands print: JSON for machines, tables for people."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from difffilter.errors import printable
from difffilter.files import json_text

if TYPE_CHECKING:
    from difffilter.comparison.comparison import Comparison
    from difffilter.scenario.case import Case

__all__ = ["aside", "comparison_text", "note", "number", "print_json", "say", "table"]


def say(text: str) -> None:
    """Lines on stdout. Nothing of them moves the cursor or turns the direction of writing."""
    print("\n".join(printable(line, most=len(line)) for line in text.split("\n")))


def print_json(data: Mapping[str, Any]) -> None:
    """One JSON object on stdout."""
    print(json_text(data))


def note(text: str) -> None:
    """A line beside the result, on stderr."""
    aside(f"note: {text}")


def aside(text: str) -> None:
    """A line on stderr, at once."""
    print(f"difffilter: {printable(text)}", file=sys.stderr, flush=True)


def number(value: Any) -> str:
    """A number, vector or matrix to six digits."""
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(number(item) for item in value) + "]"
    return f"{value:.6g}"


def table(head: Sequence[str], rows: Iterable[Sequence[str]], indent: str = "  ") -> str:
    """Columns of text, as wide as their widest cell."""
    lines = [[printable(cell) for cell in line] for line in (head, *rows)]
    widths = [max(len(cell) for cell in column) for column in zip(*lines, strict=True)]
    return "\n".join(
        (indent + "  ".join(cell.ljust(w) for cell, w in zip(line, widths, strict=True))).rstrip()
        for line in lines
    )


def comparison_text(comparison: Comparison, scenario: Case) -> str:
    """The comparison's table, and what its reference and its bound are."""
    system, values = comparison.reference.rsplit(" ", 1)
    legend = f"Ratios: RMSE divided by that of {system} with {values} values, same trajectories."
    told = {
        row.system: ", with published noise no bound" if row.values == "published" else ""
        for row in reversed(comparison.rows)
        if scenario.systems[row.system.removesuffix(" smoothed")].clairvoyant
    }
    for name, note in told.items():
        legend += f" {name}: told of every fault, to aim at, not to deploy{note}."
    legend += " NEES per state and NIS per channel: 1 where errors are as large as claimed."
    return f"{comparison.markdown()}\n{legend}\n"
