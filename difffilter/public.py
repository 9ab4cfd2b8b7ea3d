"""Public names, from the one list of them: ``difffilter/__init__.pyi``, one line each.

The package and each room offer theirs when they are first used, so that importing one costs
nothing and a name stands in one list alone.
"""

from __future__ import annotations

import ast
from collections.abc import Callable
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

__all__ = ["Public", "homes", "offered"]


class Public(NamedTuple):
    """What a package says of its names: its own ``__all__``, ``__getattr__`` and ``__dir__``."""

    names: list[str]
    get: Callable[[str], Any]
    list: Callable[[], list[str]]


@cache
def homes() -> dict[str, str]:
    """Module of each public name."""
    stub = ast.parse(Path(__file__).with_name("__init__.pyi").read_text(encoding="utf-8"))
    return {
        entry.name: str(node.module)
        for node in stub.body
        if isinstance(node, ast.ImportFrom)
        for entry in node.names
    }


def offered(package: str, space: dict[str, Any]) -> Public:
    """The public names that live in the package, imported into its ``space`` at first use.

    A room does not offer what has the name of one of its modules: ``sensors.sensor`` is the
    module, ``difffilter.sensor`` the function.
    """
    names = sorted(
        name
        for name, home in homes().items()
        if home.startswith(f"{package}.") and not _is_module(f"{package}.{name}")
    )

    def get(name: str) -> Any:
        if name in names:
            value = getattr(import_module(homes()[name]), name)
        elif _is_module(f"{package}.{name}"):
            value = import_module(f"{package}.{name}")
        else:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        space[name] = value
        return value

    return Public(names, get, lambda: sorted({*space, *names}))


def _is_module(name: str) -> bool:
    """Whether there is a module of that name, without importing it."""
    folder = Path(__file__).parent.joinpath(*name.split(".")[1:])
    return folder.is_dir() or folder.with_suffix(".py").is_file()
