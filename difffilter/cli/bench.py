"""``difffilter bench``: what a pass costs on this machine, beside other libraries."""

from __future__ import annotations

from argparse import Namespace
from dataclasses import replace
from pathlib import Path

from difffilter.cli.options import Commands, check_place, shows_progress, whole
from difffilter.cli.output import aside, say

__all__ = ["add"]

OUT = "report/bench"
EXAMPLE = """\
examples:
  difffilter bench --quick
  difffilter bench --out my-machine --peers jax
  difffilter bench --peers none --json

Peers are those of the extra bench that are installed: pip install 'difffilter[bench]'. All
contenders must compute the same losses and gradients before anything is timed. Leave the
machine alone meanwhile: some ten minutes on two cores. Claims that do not hold are reported
as such; the exit code is 0 all the same.
"""


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "bench",
        help="measure speed, memory and start on this machine",
        description="Time losses and gradients of a TDOA filter by both engines and by other "
        "libraries, peak memory, streaming, compilation and a tuning; write a report.",
        example=EXAMPLE,
    )
    parser.add_argument("--quick", action="store_true", help="small sizes, under a minute")
    parser.add_argument("--out", metavar="FOLDER", default=OUT, help=f"of the report ({OUT})")
    parser.add_argument("--repetitions", type=whole(1), metavar="N", help="at most, of each job")
    parser.add_argument(
        "--peers",
        metavar="NAMES",
        help="some of jax,dynamax,filterpy, or none (those that are installed)",
    )
    parser.add_json()
    parser.add_quiet()
    parser.set_defaults(command=command)


def command(args: Namespace) -> int:
    """Measure, write, print."""
    folder = Path(args.out)
    check_place(str(folder / "report.md"))

    from difffilter.bench.findings import measure
    from difffilter.bench.machine import machine, need_compiler
    from difffilter.bench.peers import chosen
    from difffilter.bench.sizes import FULL, QUICK
    from difffilter.bench.tables import write

    need_compiler()
    peers = chosen(args.peers)
    sizes = QUICK if args.quick else FULL
    if args.repetitions is not None:
        sizes = replace(sizes, repetitions=args.repetitions)
    tell = aside if shows_progress(args) else _silent
    path = write(folder, measure(sizes, peers, tell), sizes, machine(peers), args.quick)
    shown = path.with_name("report.json") if args.json else path
    say(shown.read_text(encoding="utf-8").rstrip())
    return 0


def _silent(stage: str) -> None:
    """For machines."""
