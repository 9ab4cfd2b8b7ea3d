"""``difffilter compare``: systems and sets of values on the same held-out trajectories."""

from __future__ import annotations

from argparse import Namespace
from typing import TYPE_CHECKING, Any

from difffilter.cli.logs import need_log, not_clairvoyant, read_logs
from difffilter.cli.options import Commands, check_place, load_case, shows_progress, whole
from difffilter.cli.output import comparison_text, note, print_json, say
from difffilter.cli.values import HELP, own_checkpoint, read_values, unfit
from difffilter.errors import InputError
from difffilter.files import json_text, write_atomically

if TYPE_CHECKING:
    from difffilter.logs.log import Log
    from difffilter.scenario.case import Case
    from difffilter.scenario.checkpoint import Checkpoint

__all__ = ["add"]

TRAJECTORIES, SEED = 200, 1
EXAMPLE = """\
examples:
  difffilter compare airport-mlat --values published --values mine.json
  difffilter compare airport-mlat --system ekf --system m-ekf --trajectories 50 --json
  difffilter compare airport-mlat --values published --values mine.json --worlds
  difffilter compare airport-mlat --system told --values published --values mine.json
  difffilter compare uwb-ranges --log los_A1.csv los_A2.csv

Published values run every system; a checkpoint runs its own. RMSE and ratios have 95 %
bootstrap intervals over trajectories; every row of the table uses the same ones.
"""


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "compare",
        help="compare systems and values on held-out trajectories",
        description="Run every system of a scenario, and every set of values, on the same "
        "held-out trajectories.",
        example=EXAMPLE,
    )
    parser.add_scenario(models=True)
    parser.add_argument(
        "--values",
        metavar="VALUES",
        action="append",
        help=f"{HELP} (repeatable; published, and tuned if the package has it)",
    )
    parser.add_argument(
        "--system",
        metavar="NAME",
        action="append",
        help="only this (repeatable); told: those that are told of every fault",
    )
    parser.add_argument("--trajectories", type=whole(1), help=f"how many ({TRAJECTORIES})")
    parser.add_argument("--seed", type=whole(0), help=f"of the held-out trajectories ({SEED})")
    parser.add_argument(
        "--log",
        metavar="FILE",
        nargs="+",
        help="recorded logs, instead of simulation; without truth, by what is foretold of them",
    )
    parser.add_argument(
        "--worlds",
        action="store_true",
        help="in every one of the scenario's [[worlds]]; the system that is tuned, or --system",
    )
    parser.add_argument(
        "--smooth", action="store_true", help="a smoothed row beside each system that has one"
    )
    parser.add_argument(
        "--states", action="store_true", help="a second table: the RMSE of each true state"
    )
    parser.add_argument("--out", metavar="FILE", help="write it too: .json or .md")
    parser.add_engine()
    parser.add_json()
    parser.add_quiet()
    parser.set_defaults(command=command)


def command(args: Namespace) -> int:
    """Compare, print, write."""
    check_place(args.out, (".json", ".md"))
    if args.log:
        for option in ("trajectories", "seed"):
            if getattr(args, option) is not None:
                raise InputError(f"--{option}: found beside --log, expected one of them")
    scenario = load_case(args)
    systems = _systems(scenario, args)
    values = _values(scenario, args.values, systems)
    log = read_logs(scenario, args.log)
    need_log(scenario, log)
    options: dict[str, Any] = {
        "trajectories": TRAJECTORIES if args.trajectories is None else args.trajectories,
        "seed": SEED if args.seed is None else args.seed,
        "log": log,
        "progress": shows_progress(args),
        "engine": args.engine,
    }
    for option in ("smooth", "states"):
        if args.worlds and getattr(args, option):
            raise InputError(f"--{option}: found beside --worlds, expected one of them")
    if args.worlds:
        return _worlds(args, scenario, values, options)
    if log is not None and log.truth is None:
        return _without_truth(args, scenario, values, log, systems)

    from difffilter.comparison.comparison import compare, unsmoothable

    if args.smooth:
        for name in systems:
            if reason := unsmoothable(scenario.system(name)):
                note(f"{name}: no smoothed row: {reason}")
    comparison = compare(scenario, values, systems=systems, smooth=args.smooth, **options)
    as_json, text = json_text(comparison.as_dict()), comparison_text(comparison, scenario)
    if args.states:
        text += f"\nRMSE of each state, in its own unit:\n\n{comparison.states_markdown()}"
    if args.out:
        write_atomically(args.out, as_json + "\n" if args.out.endswith(".json") else text)
    if args.json:
        print_json(comparison.as_dict())
    else:
        data = f"recorded logs: {comparison.trajectories}" if args.log else (
            f"{comparison.trajectories} held-out trajectories, seed {comparison.seed}"
        )  # fmt: skip
        say(f"{scenario.name}: {data}\n\n{text}".rstrip("\n"))
    return 0


def _worlds(
    args: Namespace,
    scenario: Case,
    values: dict[str, Checkpoint | None],
    options: dict[str, Any],
) -> int:
    """Compare in every world, print, write."""
    from difffilter.comparison.comparison import resolved
    from difffilter.comparison.worlds import compare_worlds
    from difffilter.scenario.scenario import Scenario

    if not isinstance(scenario, Scenario):
        raise InputError(f"--worlds: found {scenario.name}, expected a scenario with [[worlds]]")
    asked = resolved(scenario, args.system or ())
    found = compare_worlds(scenario, values, systems=asked, **options)
    as_json, text = json_text(found.as_dict()), found.markdown()
    if args.out:
        write_atomically(args.out, as_json + "\n" if args.out.endswith(".json") else text)
    head = f"{scenario.name}: {len(found.family)} worlds\n\n"
    if args.json:
        print_json(found.as_dict())
    else:
        say(head + text.rstrip("\n"))
    return 0


def _without_truth(
    args: Namespace,
    scenario: Case,
    values: dict[str, Checkpoint | None],
    log: Log,
    systems: tuple[str, ...],
) -> int:
    """Compare by what is foretold, print, write."""
    from difffilter.comparison.without_truth import compare_without_truth

    for option in ("smooth", "states"):
        if getattr(args, option):
            raise InputError(f"--{option}: found logs without truth, expected truth columns")
    found = compare_without_truth(scenario, values, log=log, systems=systems, engine=args.engine)
    as_json, text = json_text(found.as_dict()), found.markdown()
    if args.out:
        write_atomically(args.out, as_json + "\n" if args.out.endswith(".json") else text)
    if args.json:
        print_json(found.as_dict())
    else:
        count = f"recorded logs without truth: {found.trajectories}"
        hidden = f"hidden windows of {found.seconds:.6g} s"
        say(f"{scenario.name}: {count}; {hidden}\n\n{text}".rstrip("\n"))
    return 0


def _systems(scenario: Case, args: Namespace) -> tuple[str, ...]:
    """The systems that were asked for; by default all that the data can serve."""
    from difffilter.comparison.comparison import resolved

    asked = resolved(scenario, args.system or ())
    for name in asked:
        scenario.system(name)
        if args.log:
            not_clairvoyant(scenario, name)
    if asked:
        return asked
    return tuple(n for n, spec in scenario.systems.items() if not (args.log and spec.clairvoyant))


def _values(
    scenario: Case, labels: list[str] | None, systems: tuple[str, ...]
) -> dict[str, Checkpoint | None]:
    """Checkpoints by label: those asked for must fit, the package's own one may."""
    from difffilter.comparison.comparison import told_by

    if labels is None:
        values: dict[str, Checkpoint | None] = {"published": None}
        if own_checkpoint(scenario).is_file():
            own = read_values("tuned", scenario)
            assert own is not None
            problem = unfit(own, scenario, own.system) if own.system in scenario.systems else ""
            if problem:
                note(f"the package's tuned values are left out: {problem}")
            elif own.system in systems or told_by(scenario, systems, own):
                values["tuned"] = own
        return values
    values = {label: read_values(label, scenario) for label in labels}
    for label, checkpoint in values.items():
        if checkpoint is None:
            continue
        if checkpoint.system not in systems and not told_by(scenario, systems, checkpoint):
            raise InputError(
                f"--values {label}: tuned for system {checkpoint.system}, "
                f"expected one of {', '.join(systems)}"
            )
        problem = unfit(checkpoint, scenario, checkpoint.system)
        if problem:
            raise InputError(f"--values {label}: {problem}")
    return values
