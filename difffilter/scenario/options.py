"""The options of a filter in a scenario file: each with its reader and what a Filter makes of it.

A new option of :class:`Filter` is one entry here. Checkpoints, ``show`` and the check that no
baseline has such a key follow.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from difffilter.adaptation.chain import Chain
from difffilter.adaptation.protocol import Adaptation
from difffilter.adaptation.registry import ADAPTATIONS, Host
from difffilter.filters.filter import RULES, STANDARDISATIONS
from difffilter.robust.gate import ACTIONS, Gate
from difffilter.robust.groups import DISTANCES, SCOPES, Scope
from difffilter.robust.recovery import RECOVERIES, Recovery
from difffilter.scenario.table import Table
from difffilter.weights.registry import WEIGHTS

__all__ = ["FUSIONS", "OPTIONS", "Option", "adaptation_names"]

FUSIONS = ("none", "distributed")


def _itself(value: Any, host: Host) -> Any:
    return value


class Option(NamedTuple):
    """One key of ``[systems.NAME]`` that becomes one argument of :class:`Filter`.

    Attributes:
        read: the key's value from the table, checked.
        make: the argument from that value, for a filter of that weight, systems and axes.
    """

    read: Callable[[Table, str], Any]
    make: Callable[[Any, Host], Any] = _itself


def _choice(choices: Sequence[str], default: str | None) -> Callable[[Table, str], Any]:
    return lambda table, key: table.text(key, default, choices=tuple(choices))


def _flag(table: Table, key: str) -> bool:
    return table.flag(key)


def _named(choices: Sequence[str], make: Callable[[str, Host], Any]) -> Option:
    """A word among ``choices``, or ``none``."""
    return Option(
        lambda table, key: table.text(key, "none", choices=("none", *choices)),
        lambda word, host: None if word == "none" else make(word, host),
    )


def _scope(table: Table, key: str) -> Scope:
    """A word, or a table of groups of channels."""
    if not isinstance(table.data.get(key), dict):
        return table.text(key, "channel", choices=SCOPES)
    groups = table.table(key)
    return {name: groups.names(name) for name in groups.data}


def adaptation_names(value: str | tuple[str, ...]) -> tuple[str, ...]:
    """Names of the plug-ins, in order."""
    if isinstance(value, tuple):
        return value
    return () if value == "none" else (value,)


def _adaptation(table: Table, key: str) -> str | tuple[str, ...]:
    """A name, or a list of names."""
    if isinstance(table.data.get(key), list):
        names = table.names(key)
        if not set(names) <= set(ADAPTATIONS) or len(set(names)) != len(names):
            table.fail(key, f"names among {', '.join(ADAPTATIONS)}, none twice")
        return names
    return table.text(key, "none", choices=("none", *ADAPTATIONS))


def _plug_in(value: str | tuple[str, ...], host: Host) -> Adaptation | None:
    """The plug-in of that name, or a chain of several."""
    parts = tuple(ADAPTATIONS[name](host) for name in adaptation_names(value))
    if not parts:
        return None
    return parts[0] if len(parts) == 1 else Chain(parts)


#: Each option of a filter, by its key in scenario files and its name in :class:`Filter`.
OPTIONS: dict[str, Option] = {
    "weight": Option(
        lambda table, key: table.text(key, "plain", choices=tuple(WEIGHTS)),
        lambda name, host: WEIGHTS[name],
    ),
    "standardise": Option(_choice(STANDARDISATIONS, None)),
    "iterations": Option(lambda table, key: table.integer(key, 0)),
    "weigh_prior": Option(_flag),
    "mad": Option(_flag),
    "scope": Option(_scope),
    "distance": Option(_choice(DISTANCES, "rms")),
    "gate": _named(ACTIONS, lambda word, host: Gate(word)),
    "recovery": _named(RECOVERIES, lambda word, host: Recovery(word)),
    "federated": Option(_flag),
    "shares": Option(lambda table, key: table.numbers(key, None, ())),
    "adaptation": Option(_adaptation, _plug_in),
    "linearise": Option(_choice(RULES, "taylor")),
    "clairvoyant": Option(_flag),
}
