"""``difffilter show``: a scenario's world and its published values."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from difffilter.cli.options import Commands, load_named
from difffilter.cli.output import number, print_json, say, table

if TYPE_CHECKING:
    from difffilter.parameters.parameters import Parameter
    from difffilter.scenario.scenario import Scenario

__all__ = ["add"]

EXAMPLE = """\
examples:
  difffilter show airport-mlat
  difffilter show airport-mlat --set faults.nlos.probability=0.1 --json

Every line "key = value" of the world is a key for --set.
"""
WORLD = (
    "axes",
    "inputs",
    "world",
    "sensors",
    "faults",
    "start",
    "motion",
    "worlds",
    "scenes",
    "score",
    "score_states",
)


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "show",
        help="print a scenario's world and published values",
        description="Print a scenario's world, its published values with units and sources.",
        example=EXAMPLE,
    )
    parser.add_scenario()
    parser.add_json()
    parser.set_defaults(command=command)


def command(args: Namespace) -> int:
    """Print the scenario."""
    scenario = load_named(args)
    if args.json:
        print_json(_data(scenario))
    else:
        say("\n".join(_text(scenario)))
    return 0


def _parameters(scenario: Scenario) -> list[dict[str, Any]]:
    return [
        {
            "name": parameter.name,
            "value": parameter.tensor().tolist(),
            "unit": parameter.unit,
            "source": parameter.source,
            "tuned": parameter.tuned,
            "meaning": parameter.meaning,
        }
        for parameter in scenario.declarations().values()
    ]


def _data(scenario: Scenario) -> dict[str, Any]:
    document = scenario.document
    return {
        "name": scenario.name,
        "title": scenario.title,
        "source": scenario.source,
        "notes": scenario.notes,
        **{key: document[key] for key in WORLD if key in document},
        "channels": scenario.channels,
        "parameters": _parameters(scenario),
        "systems": document["systems"],
        "tuning": vars(scenario.tuning),
        "runs": scenario.runs,
        "references": [vars(reference) for reference in scenario.references],
    }


def _text(scenario: Scenario) -> Iterator[str]:
    from difffilter.scenario.systems import recipes

    document = scenario.document
    yield f"{scenario.name}: {scenario.title}"
    if scenario.source:
        yield f"Source: {scenario.source}"
    yield from (f"Note: {text}" for text in scenario.notes)
    world = "World" if scenario.world else "Recorded logs (no world to simulate)"
    yield f"\n{world}; channels {', '.join(scenario.channels)}"
    for key in WORLD:
        if key in document:
            yield from _lines(key, document[key])
    yield "\nPublished values"
    head = ["parameter", "value", "unit", "tuned", "source"]
    yield table(
        head,
        (
            [p.name, _value(p), p.shown[0], "yes" if p.tuned else "", p.source]
            for p in scenario.declarations().values()
        ),
    )
    yield "\nSystems"
    yield table(["system", "recipe"], recipes(document["systems"]).items())
    loss = " + ".join(f"{weight:g} {name}" for name, weight in scenario.tuning.loss.items())
    yield f"\nTuning: {scenario.tuning.system} by {loss}"
    if scenario.runs:
        yield f"Runs with positions of their own: {', '.join(scenario.runs)}"
    if scenario.references:
        yield "\nResults of others (not produced here)"
        yield table(
            ["run", "system", "RMSE (m)", "source"],
            ([r.run, r.system, f"{r.rmse:g}", r.source] for r in scenario.references),
        )


def _value(parameter: Parameter) -> str:
    """The published value in the unit that it was given in."""
    return number((parameter.tensor() / parameter.shown[1]).tolist())


def _lines(key: str, value: Any) -> Iterator[str]:
    """One line per value: its dotted key and the value as TOML has it."""
    if isinstance(value, Mapping) and value:
        for name, item in value.items():
            yield from _lines(f'{key}."{name}"' if "." in name else f"{key}.{name}", item)
    elif isinstance(value, list) and value and all(isinstance(item, dict) for item in value):
        for i, item in enumerate(value):
            yield from _lines(f"{key}.{i}", item)
    else:
        yield f"  {key} = {json.dumps(value)}"
