"""Keys of a table by the typed keyword arguments of what they are for."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping
from functools import cache
from typing import Any, Literal, get_args, get_origin, get_type_hints

from difffilter.errors import InputError
from difffilter.parameters.parameters import Number
from difffilter.scenario.table import Table

__all__ = ["keywords", "made", "missing", "published", "read_keys"]

#: What is read by the method of that name.
SIMPLE: dict[Any, str] = {float: "number", int: "integer", str: "text"}


@cache
def keywords(factory: Callable[..., Any]) -> dict[str, tuple[Any, Any]]:
    """Type and default of each keyword argument, by name; the default is empty where none is."""
    hints = get_type_hints(factory)
    own = vars(factory) if inspect.isclass(factory) else {}
    if "__init__" in own and "__dataclass_params__" not in own:
        hints |= get_type_hints(own["__init__"])
    found = {}
    for name, argument in inspect.signature(factory).parameters.items():
        if argument.kind in (argument.KEYWORD_ONLY, argument.POSITIONAL_OR_KEYWORD):
            found[name] = (hints.get(name), argument.default)
    return found


def read_keys(
    table: Table, factory: Callable[..., Any], without: Collection[str]
) -> dict[str, Any]:
    """The keys that the factory takes, beside those ``without``.

    Numbers that may be vectors are no keys: they are published under ``[parameters]``.

    Raises:
        InputError: a value of the wrong kind, a type that no key has.
    """
    found = {}
    for name, (hint, _) in keywords(factory).items():
        if name in without or hint in (Number, Number | None):
            continue
        table.take(name, "", None)
        if name in table:
            found[name] = _read(table, name, hint)
    return found


def _read(table: Table, name: str, hint: Any) -> Any:
    """One key by its type."""
    kinds = [kind for kind in get_args(hint) if kind is not type(None)]
    if type(None) in get_args(hint) and len(kinds) == 1:
        hint = kinds[0]
    if hint is bool:
        return table.flag(name)
    if hint in SIMPLE:
        return getattr(table, SIMPLE[hint])(name)
    if get_origin(hint) is Literal:
        return table.text(name, choices=get_args(hint))
    inner = get_args(hint)[0] if get_args(hint) else None
    if inner is str:
        return table.names(name)
    if inner is float:
        return table.numbers(name)
    if get_args(inner)[:1] == (float,):
        return table.points(name)
    return table.fail(name, f"no such key: {hint} is no type that a key can have")


def published(
    factory: Callable[..., Any], component: str, values: Mapping[str, Number]
) -> dict[str, Number]:
    """Published values ``COMPONENT.FIELD`` as keyword arguments FIELD, where there are such."""
    own = keywords(factory)
    fields = {name.removeprefix(f"{component}."): value for name, value in values.items()}
    return {
        field: value
        for field, value in fields.items()
        if field in own and f"{component}.{field}" in values
    }


def missing(factory: Callable[..., Any], given: Mapping[str, Any]) -> str | None:
    """The first keyword without a default that is not given."""
    wanted = keywords(factory).items()
    empty = inspect.Parameter.empty
    return next((name for name, (_, d) in wanted if d is empty and name not in given), None)


def made(table: Table, factory: Callable[..., Any], given: Mapping[str, Any]) -> Any:
    """What the factory makes; its errors name the table."""
    lacking = missing(factory, given)
    if lacking is not None:
        table.fail(lacking, "the key")
    try:
        return factory(**given)
    except InputError as error:
        above, _, own = table.path.rpartition(".")
        text = f"{above}.{error}" if str(error).startswith(f"{own}.") else f"{table.path}: {error}"
        raise InputError(f"{table.where}: {text}") from None
