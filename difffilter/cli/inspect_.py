"""``difffilter inspect``: what a log says about itself and its sensors."""

from __future__ import annotations

from argparse import Namespace
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from difffilter.cli.options import Commands, check_place, load_case
from difffilter.cli.output import note, number, print_json, say, table
from difffilter.errors import InputError, LogError
from difffilter.files import write_atomically

if TYPE_CHECKING:
    from difffilter.logs.log import Log
    from difffilter.scenario.case import Case
    from difffilter.scenario.inspection import Inspection

__all__ = ["add"]

EXAMPLE = """\
examples:
  difffilter inspect log.csv
  difffilter inspect los_A1.csv uwb-ranges --toml proposed.toml --plot errors.png

Without a scenario: rates, gaps, silent channels. With one: the start that it would take, and
where the log has truth the errors of each channel and the values that they propose.
"""


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "inspect",
        help="what a log is like: rates, gaps, errors against truth",
        description="Look at a log before anything runs over it.",
        example=EXAMPLE,
    )
    parser.add_argument("log", metavar="LOG", help="a log, as run reads it")
    parser.add_argument(
        "scenario", metavar="SCENARIO", nargs="?",
        help="a name, a .toml file, or MODULE:FUNCTION of --models",
    )  # fmt: skip
    parser.add_argument("--system", metavar="NAME", help="default: the one that is tuned")
    parser.add_argument("--toml", metavar="FILE", help="write the proposed values, .toml")
    parser.add_argument("--plot", metavar="FILE", help="figure of the errors, PNG and SVG")
    parser.add_set()
    parser.add_models()
    parser.add_json()
    parser.set_defaults(command=command)


def command(args: Namespace) -> int:
    """Read, look, tell."""
    check_place(args.toml, (".toml",))
    check_place(args.plot)

    from difffilter.scenario.inspection import inspect_log

    log, case = _read(args)
    found = inspect_log(log, case, args.system)
    for wanted in ("toml", "plot"):
        if getattr(args, wanted) and found.errors is None:
            raise InputError(f"--{wanted}: found no truth or no scenario, expected a log with both")
    if args.toml:
        write_atomically(args.toml, found.toml())
    if args.plot and found.errors is not None and found.residuals is not None:
        from difffilter.reports.figures.residuals import residual_figure
        from difffilter.reports.figures.style import save_figure

        units = " or ".join(dict.fromkeys(p.unit for p in found.proposals))
        names = tuple(c for p in found.proposals for c in p.channels)
        save_figure(residual_figure(log.time.numpy(), found.errors, names, units), args.plot)
    if args.json:
        print_json(found.as_dict())
    else:
        say("\n".join(_text(args.log, found)))
    return 0


def _read(args: Namespace) -> tuple[Log, Case | None]:
    from difffilter.logs.logfile import read_any
    from difffilter.scenario.recorded import read_run, scenario_of_run, stacked
    from difffilter.scenario.scenario import Scenario
    from difffilter.scenario.sources import as_log

    if args.scenario is None:
        if args.system or args.set:
            raise InputError("--system, --set: found no SCENARIO beside it, expected one")
        return read_any(args.log), None
    case = load_case(args)
    if not isinstance(case, Scenario):
        return as_log(case, [args.log]).alone(), case
    read = read_run(case, args.log)
    for line in read.told:
        note(line)
    try:
        stacked(case, [read])
    except LogError as error:  # told, and what the log says of itself all the same
        note(str(error))
    return read.log, replace(scenario_of_run(case, Path(args.log).stem), runs={})


def _text(name: str, found: Inspection) -> Iterator[str]:
    times = found.timing
    rate = f", {1.0 / times.interval:.4g} per second" if times.interval else ""
    yield f"{name}: {times.rows} rows over {times.seconds:.6g} s{rate}"
    if times.gaps:
        length, at = times.longest
        yield f"  {times.gaps} gaps; the longest takes {length:.4g} s, from {at:.6g} s"
    if times.duplicates or times.reversals:
        again, back = times.duplicates, times.reversals
        yield f"  {again} rows at the time of the row before, {back} before it"
    yield table(
        ["channel", "values", "per second", "longest silence (s)", "least", "most", ""],
        (
            [
                n, str(p.count), number(p.rate), number(p.longest[0]), number(p.low),
                number(p.high), p.dead,
            ]
            for n, p in found.pulses.items()
        ),
    )  # fmt: skip
    if isinstance(found.start, str):
        yield f"No start: {found.start}"
    elif found.start is not None:
        yield "Start"
        rows = ([n, number(m), number(s)] for n, (m, s) in found.start.items())
        yield table(["state", "mean", "standard deviation"], rows)
    if found.residuals:
        yield from _errors(found)


def _errors(found: Inspection) -> Iterator[str]:
    assert found.residuals is not None
    yield "Errors against truth"
    head = [
        "channel", "median", "sigma (MAD)", "beyond 3 sigma", "largest", "new in each row",
        "goes on", "time (s)", "correlation with others",
    ]  # fmt: skip
    yield table(
        head,
        (
            [
                n, f"{r.bias:.4g}", f"{r.sigma:.4g}", f"{100 * r.tails:.2g} %", f"{r.largest:.4g}",
                f"{r.own.white:.3g}", f"{r.own.sigma:.3g}", f"{r.own.time:.3g}",
                ", ".join(f"{v:.2f}" for v in r.with_others.values()),
            ]
            for n, r in found.residuals.items()
        ),
    )  # fmt: skip
    for one in found.proposals:
        yield f"Proposed for {one.sensor}"
        yield from (f"  {reason}" for reason in one.reasons)
