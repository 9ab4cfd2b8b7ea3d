"""Options that several commands share, and how their values are checked."""

from __future__ import annotations

import argparse
import math
import os
import sys
from argparse import ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, Protocol

from difffilter.errors import InputError, printable, shown

if TYPE_CHECKING:
    from difffilter.scenario.case import Case
    from difffilter.scenario.scenario import Scenario

__all__ = [
    "Commands",
    "Parser",
    "Version",
    "check_place",
    "load_case",
    "load_named",
    "named_weight",
    "overrides",
    "shows_progress",
    "whole",
    "with_overrides",
]


class Parser(ArgumentParser):
    """argparse with one-line errors, no abbreviations and an example under the help."""

    def __init__(self, prog: str, description: str, example: str, **more: Any) -> None:
        super().__init__(
            prog,
            description=description,
            epilog=example,
            formatter_class=argparse.RawDescriptionHelpFormatter,
            allow_abbrev=False,
            **more,
        )

    def error(self, message: str) -> NoReturn:
        """One line that names the option, and where to read more."""
        line = printable(" ".join(message.split()))
        self.exit(2, f"difffilter: error: {line} (see {self.prog} --help)\n")

    def add_scenario(self, models: bool = False) -> None:
        """SCENARIO and --set; with ``models`` --models, and SCENARIO may name a factory."""
        more = "; or MODULE:FUNCTION of --models" if models else ""
        self.add_argument(
            "scenario",
            metavar="SCENARIO",
            help=f"a name (see difffilter scenarios) or a .toml file{more}",
        )
        self.add_set()
        if models:
            self.add_models()

    def add_models(self) -> None:
        """--models, repeatable."""
        self.add_argument(
            "--models",
            metavar="FILE.py",
            action="append",
            default=[],
            help="Python file with models of your own: it is run (repeatable)",
        )

    def add_set(self) -> None:
        """--set, repeatable."""
        self.add_argument(
            "--set",
            metavar="KEY.PATH=VALUE",
            action="append",
            default=[],
            help="override any value of the scenario, e.g. faults.nlos.scale=50 (repeatable)",
        )

    def add_json(self) -> None:
        """--json."""
        self.add_argument("--json", action="store_true", help="print one JSON object, nothing else")

    def add_quiet(self) -> None:
        """--quiet."""
        self.add_argument("--quiet", action="store_true", help="no progress bar")

    def add_engine(self) -> None:
        """--engine."""
        self.add_argument(
            "--engine",
            choices=("auto", "torch", "fused"),
            default="auto",
            help="fused: filters compiled to C; auto: those where it can and pays (auto)",
        )

    def add_seed(self, default: int, what: str) -> None:
        """--seed."""
        self.add_argument("--seed", type=whole(0), default=default, help=f"{what} ({default})")


class Version(argparse.Action):
    """--version; what knows it is imported only then."""

    def __call__(self, parser: ArgumentParser, *ignored: Any) -> NoReturn:
        """Print and exit."""
        from importlib.metadata import version

        print(f"difffilter {version('difffilter')}")
        parser.exit()


class Commands(Protocol):
    """The part of argparse's subparsers that a command uses (their type is private)."""

    def add_parser(self, name: str, **options: Any) -> Parser:
        """A parser for one command."""


def whole(low: int) -> Callable[[str], int]:
    """Reader of a whole number of at least ``low``."""

    def read(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            value = low - 1
        if value < low:
            expected = f"expected a whole number of {low} or more"
            raise ArgumentTypeError(f"found {shown(text)}, {expected}")
        return value

    return read


def named_weight(text: str) -> tuple[str, float]:
    """Reader of ``name=weight``."""
    name, _, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if not name or not math.isfinite(value) or value < 0:
        expected = "expected name=weight with a weight of 0 or more"
        raise ArgumentTypeError(f"found {shown(text)}, {expected}")
    return name.strip(), value


def overrides(args: Namespace) -> dict[str, Any]:
    """What --set says: dotted keys and values."""
    from difffilter.scenario.document import parse_override

    return dict(parse_override(text) for text in args.set)


def load_named(args: Namespace, more: dict[str, Any] | None = None) -> Scenario:
    """The scenario that the arguments name, with --set and ``more`` applied."""
    from difffilter.scenario.scenario import load_scenario

    changes = overrides(args) | (more or {})
    return _over_runs(load_scenario(args.scenario, changes), changes)


def load_case(args: Namespace, more: dict[str, Any] | None = None) -> Case:
    """The scenario that the arguments name, or the model of a factory MODULE:FUNCTION."""
    if ":" not in args.scenario or args.scenario.endswith(".toml"):
        return load_named(args, more)
    from difffilter.scenario.own import made

    return made(args.scenario).with_overrides(overrides(args) | (more or {}))


def with_overrides(scenario: Case, changes: dict[str, Any]) -> Case:
    """A loaded scenario or model with --set applied."""
    from difffilter.scenario.scenario import Scenario

    if not changes:
        return scenario
    changed = scenario.with_overrides(changes)
    return _over_runs(changed, changes) if isinstance(changed, Scenario) else changed


def _over_runs(scenario: Scenario, changes: dict[str, Any]) -> Scenario:
    """--set is stronger than the overrides of ``[runs]``, too."""
    return replace(scenario, runs={name: {**run, **changes} for name, run in scenario.runs.items()})


def check_place(path: str | None, suffixes: tuple[str, ...] = ()) -> None:
    """Raise InputError, before any work, if a file cannot be written at ``path``."""
    if path is None:
        return
    place = Path(path)
    if suffixes and place.suffix not in suffixes:
        raise InputError(f"{path}: expected a name that ends in {' or '.join(suffixes)}")
    if place.is_dir():
        raise InputError(f"{path}: cannot be written: is a folder, expected a file")
    folder = next(parent for parent in place.absolute().parents if parent.exists())
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise InputError(f"{path}: cannot be written: {folder} is not a writable folder")


def shows_progress(args: Namespace) -> bool:
    """Whether to draw bars: for a person at a terminal alone."""
    return not args.json and not args.quiet and sys.stderr.isatty()
