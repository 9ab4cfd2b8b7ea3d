"""The ``[log]`` table: how recorded logs of a scenario are stored."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

from difffilter.errors import InputError
from difffilter.logs.layout import Form, Layout, Source
from difffilter.logs.times import FORMATS
from difffilter.scenario.table import Table

__all__ = ["read_form"]


def read_form(table: Table) -> Form:
    """Read ``[log]``, and ``[log.files.NAME]`` of a log in several files."""
    gap = table.number("gap", None, above=0.0)
    first = table.number("from", 0.0, low=0.0)
    last = table.number("until", None, above=first)
    files = table.table("files", optional=True)
    shared = _keywords(table)
    form = Form(_layout(table, shared), (), gap, first, math.inf if last is None else last)
    sources = []
    sure = set(shared.get("units", ())) | ({"time"} if "format" in shared else set())
    for name, part in files.children():
        file = part.text("file")
        if not file or file.startswith("/") or ".." in file:
            part.fail("file", "a name beside the log, as {run}_radar.csv")
        own = _keywords(part)
        sure |= set(own.get("units", ())) | ({"time"} if "format" in own else set())
        for key in ("columns", "units", "relative"):
            own[key] = {**shared.get(key, {}), **own.get(key, {})}
        sources.append(Source(name, file, _layout(part, {**shared, **own})))
        part.finish()
    table.finish()
    return replace(form, sources=tuple(sources), sure=frozenset(sure))


def _keywords(table: Table) -> dict[str, Any]:
    """What the table says of a layout; a log in a scenario is sorted unless it says no."""
    found: dict[str, Any] = {}
    for key in ("time", "zone", "separator", "decimal", "by", "value"):
        if key in table:
            found[key] = table.text(key)
    if "format" in table:
        found["format"] = table.text("format", choices=tuple(FORMATS))
    if "beyond" in table:
        found["beyond"] = table.text("beyond", choices=("error", "missing"))
    if "sort" in table:
        found["sort"] = table.flag("sort")
    if "ignore" in table:
        found["ignore"] = table.names("ignore")
    if "missing" in table:
        found["missing"] = _missing(table)
    for key in ("columns", "units", "relative"):
        if key in table:
            part = table.table(key)
            found[key] = {name: part.text(name) for name in part.data}
    return found


def _missing(table: Table) -> tuple[str | float, ...]:
    values = table.take("missing", "a list of texts and numbers")
    sound = isinstance(values, list) and all(
        isinstance(item, (str, int, float)) and not isinstance(item, bool) for item in values
    )
    if not sound:
        table.fail("missing", "a list of texts and numbers")
    return tuple(values)


def _layout(table: Table, keywords: dict[str, Any]) -> Layout:
    try:
        return Layout(**{"sort": True, **keywords})
    except InputError as error:
        raise InputError(
            f"{table.where}: {table.path or 'log'}: {str(error).removeprefix('log: ')}"
        ) from None
