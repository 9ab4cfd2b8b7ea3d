"""A case with other parameters tuned than it declares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from difffilter.parameters.selection import matching
from difffilter.scenario.case import Case
from difffilter.scenario.model import Model, tuning_alone

__all__ = ["with_tuned"]


def with_tuned(case: Case, patterns: Sequence[str]) -> Case:
    """The case with these parameters of its recipe tuned, and no others.

    Raises:
        InputError: as :func:`difffilter.parameters.selection.matching`.
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
