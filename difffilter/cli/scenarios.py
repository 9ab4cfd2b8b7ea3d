"""``difffilter scenarios``: what is there."""

from __future__ import annotations

from argparse import Namespace

from difffilter.cli.options import Commands
from difffilter.cli.output import print_json, say, table
from difffilter.files import data_folder

__all__ = ["add"]

EXAMPLE = "example:\n  difffilter scenarios --json"


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "scenarios",
        help="list the scenarios",
        description="List the scenarios that come with the package.",
        example=EXAMPLE,
    )
    parser.add_json()
    parser.set_defaults(command=command)


def command(args: Namespace) -> int:
    """Names and titles; nothing is computed, so that it answers at once."""
    from difffilter.scenario.document import read_document, scenario_names

    found = []
    for name in scenario_names():
        document, _ = read_document(name)
        found.append(
            {
                "name": name,
                "title": document["title"],
                "recorded": "world" not in document,
                "systems": list(document["systems"]),
                "tuned": (data_folder("checkpoints") / f"{name}.json").is_file(),
            }
        )
    if args.json:
        print_json({"scenarios": found})
        return 0
    rows = [
        [
            entry["name"],
            "recorded" if entry["recorded"] else "simulated",
            "published, tuned" if entry["tuned"] else "published",
            entry["title"],
        ]
        for entry in found
    ]
    say(table(["scenario", "data", "values", "title"], rows, indent=""))
    return 0
