"""Which parameters are tuned, by name or pattern."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from fnmatch import fnmatchcase
from typing import Any

from difffilter.errors import InputError
from difffilter.parameters.parameters import Parameter
from difffilter.scenario.case import Case
from difffilter.scenario.model import Model, tuning_alone

__all__ = ["matching", "with_tuned"]


def matching(declarations: Mapping[str, Parameter], patterns: Sequence[str]) -> list[str]:
    """Names of the parameters that a pattern names (``*`` and ``?`` as in file names).

    Raises:
        InputError: no pattern, or one that names nothing.
    """
    if not patterns:
        raise InputError("tuned: found no name, expected one or more")
    found: list[str] = []
    for pattern in patterns:
        names = [name for name in declarations if fnmatchcase(name, pattern)]
        if not names:
            expected = ", ".join(declarations)
            raise InputError(f"tuned: found {pattern!r:.80}, expected names among {expected}")
        found += names
    return list(dict.fromkeys(found))


def with_tuned(case: Case, patterns: Sequence[str]) -> Case:
    """The case with these parameters of its recipe tuned, and no others.

    Raises:
        InputError: as :func:`matching`.
    """
    recipe = case.system()
    names = matching(recipe.declarations, patterns)
    if isinstance(case, Model):
        return replace(case, recipe=tuning_alone(case.recipe, names))
    changes: dict[str, Any] = {}
    known = case.document.get("parameters", {})
    for name, parameter in recipe.declarations.items():
        component, _, field = name.partition(".")
        if field in known.get(component, {}):
            changes[f"parameters.{name}.tuned"] = name in names
        elif name in names:
            value = parameter.tensor().tolist()
            changes[f"parameters.{name}"] = {
                "value": value, "unit": parameter.unit, "source": parameter.source, "tuned": True,
            }  # fmt: skip
    return case.with_overrides(changes)
