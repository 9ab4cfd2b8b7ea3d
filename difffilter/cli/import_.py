"""``difffilter import``: the files of a recorder as the one log that all commands read."""

from __future__ import annotations

from argparse import Namespace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difffilter.cli.options import Commands, check_place, load_named
from difffilter.cli.output import print_json, say
from difffilter.errors import InputError

if TYPE_CHECKING:
    from difffilter.logs.reading import Reading

__all__ = ["add"]

EXAMPLE = """\
examples:
  difffilter import ferry.toml recordings/s2 --out s2.csv
  difffilter import ferry.toml s2.csv --out again.csv --json

The [log] table of the scenario says how the files are stored. Every other command reads them
the same way; import shows what that does, and writes one log in SI units.
"""


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "import",
        help="join a recorder's files into one log",
        description="Read a log by the scenario's [log] table, tell what was done to it, and "
        "write it as one CSV file in SI units.",
        example=EXAMPLE,
    )
    parser.add_scenario()
    parser.add_argument(
        "log", metavar="LOG", help="a file; of a log in several files, what {run} stands for"
    )
    parser.add_argument("--out", metavar="FILE", required=True, help="the .csv to write")
    parser.add_json()
    parser.set_defaults(command=command)


def command(args: Namespace) -> int:
    """Read, write, report."""
    check_place(args.out, (".csv",))
    if Path(args.out).resolve() == Path(args.log).resolve():
        raise InputError(f"--out {args.out}: is the log itself, expected another file")
    scenario = load_named(args)

    from difffilter.logs.logfile import write_log
    from difffilter.scenario.recorded import read_run, stacked

    read = read_run(scenario, args.log)
    stacked(scenario, [read])  # says what is in a wrong unit before it is written as right
    write_log(args.out, read.log, f"1, {scenario.name}, SI units, {read.clock.words}")
    report = _report(read)
    if args.json:
        print_json({"scenario": scenario.name, "log": args.log, "out": args.out, **report})
        return 0
    say(f"{scenario.name}: {report['rows']} rows over {report['seconds']:.6g} s in {args.out}")
    for name, count in report["measurements"].items():
        say(f"  {name}: {count} measurements")
    for name, count in report["truth"].items():
        say(f"  truth_{name}: {count} of {report['rows']} rows")
    for line in report["told"]:
        say(f"  {line}")
    return 0


def _report(read: Reading) -> dict[str, Any]:
    log = read.log
    present = log.present.sum(0).tolist()
    truth = [] if log.truth is None else (~log.truth.isnan()).sum(0).tolist()
    return {
        "rows": log.steps,
        "seconds": float(log.time[-1] - log.time[0]),
        "first": read.clock.write(log.time[:1].numpy())[0],
        "last": read.clock.write(log.time[-1:].numpy())[0],
        "measurements": dict(zip(log.channels, present, strict=True)),
        "truth": dict(zip(log.truth_states, truth, strict=True)),
        "told": list(read.told),
    }
