"""``difffilter report``: the verdict on checkpoints, as one page."""

from __future__ import annotations

import sys
from argparse import Namespace
from pathlib import Path
from typing import Any

from difffilter.cli.logs import read_logs
from difffilter.cli.options import Commands, whole
from difffilter.cli.output import say
from difffilter.errors import InputError

__all__ = ["add"]

EXAMPLE = """\
examples:
  difffilter report mine.json --out report
  difffilter report mine.json --contest 3
  difffilter report uwb.json --log nlos_A2.csv --train los_A1.csv los_A2.csv --contest 1

Writes report.html (one file that stands alone), report.md, report.json and the figures.
"""


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "report",
        help="the verdict on tuned values: adopt them or not, and at what risk",
        description="Published against tuned values on held-out data: what changed, what each "
        "change is worth, whether the filter is honest, and how it fares beyond its training.",
        example=EXAMPLE,
    )
    parser.add_argument("checkpoint", metavar="CHECKPOINT", nargs="+", help=".json checkpoints")
    parser.add_argument(
        "--log", metavar="FILE", nargs="+",
        help="held-out recorded logs; without truth, by what is foretold of them",
    )  # fmt: skip
    parser.add_argument(
        "--trajectories", type=whole(2), default=200, help="simulated held-out ones (200)"
    )
    parser.add_seed(1, "of the held-out trajectories")
    parser.add_argument(
        "--contest", metavar="N", type=whole(0), default=0,
        help="tunings of each method (gradient, random, Nelder-Mead, CMA-ES) with the same "
        "budget, and Q and R alone; 0 leaves them out (0)",
    )  # fmt: skip
    parser.add_argument(
        "--train", metavar="FILE", nargs="+", help="recorded logs tuned on, for the contest"
    )
    parser.add_argument(
        "--bound", action="store_true",
        help="tune the filter that is told of every fault by the same loss: the bound",
    )  # fmt: skip
    parser.add_argument(
        "--guarantee", action="store_true",
        help="tune on one world, on the family and on it with guards: what a guarantee costs",
    )  # fmt: skip
    parser.add_models()
    parser.add_quiet()
    parser.add_argument("--out", metavar="FOLDER", default="report", help="folder (report)")
    parser.add_engine()
    parser.set_defaults(command=command)


def command(args: Namespace) -> int:
    """Write the report, print the advice."""
    from difffilter.scenario.checkpoint import load

    held = [load(path) for path in args.checkpoint]
    if Path(args.out).exists() and not Path(args.out).is_dir():
        raise InputError(f"--out {args.out}: found a file, expected a folder")
    if args.train and not args.log:
        raise InputError("--train: found no --log beside it, expected recorded logs to judge on")
    for checkpoint in held:
        if checkpoint.scenario.world is None and not args.log:
            raise InputError(f"{checkpoint.scenario.name}: has no world, expected --log")

    from difffilter.reports.report import Report
    from difffilter.verdict.judge import verdict, write_index
    from difffilter.verdict.without_truth import index_without_truth, verdict_without_truth

    settings = {"seed": args.seed, "trajectories": args.trajectories}
    names = _names(args.checkpoint)
    several = len(held) > 1
    judged: dict[str, tuple[str, dict[str, Any]]] = {}
    untold = False
    for name, checkpoint in zip(names, held, strict=True):
        folder = Path(args.out, name) if several else Path(args.out)
        report = Report(folder, f"{name}: published against tuned", settings)
        log = read_logs(checkpoint.scenario, args.log)
        if log is not None and log.truth is None:
            untold = True
            _no_contest(args)
            text = verdict_without_truth(report, checkpoint, log, name=name, engine=args.engine)
        else:
            text = verdict(
                report, checkpoint, args.trajectories, args.seed, log=log,
                train=read_logs(checkpoint.scenario, args.train), name=name,
                seeds=range(args.contest), progress=not args.quiet and sys.stderr.isatty(),
                engine=args.engine, bound=args.bound, guaranteed=args.guarantee,
            )  # fmt: skip
        say(f"{name}, {checkpoint.system}: {text}")
        path = report.write()
        where = f"{name}/report.html" if several else "report.html"
        judged |= {
            key: (report.verdicts[key], {**data, "page": where})
            for key, data in report.judged.items()
        }
    if several:
        report = Report(args.out, "Published against tuned", settings)
        for key, (text, data) in judged.items():
            report.verdict(key, text, data)
        index = index_without_truth if untold else write_index
        index(report, {key: data for key, (_, data) in judged.items()})
        path = report.write()
    say(f"report written to {path.with_suffix('.html')}")
    return 0


def _no_contest(args: Namespace) -> None:
    """Tuners are compared by their errors."""
    for option in ("contest", "train", "bound", "guarantee"):
        if not getattr(args, option):
            continue
        raise InputError(f"--{option}: found --log without truth, expected truth columns")


def _names(paths: list[str]) -> list[str]:
    """A name for each checkpoint: its file's, with its folder's where two are the same."""
    stems = [Path(path).stem for path in paths]
    return [
        stem if stems.count(stem) == 1 else f"{stem}-{stems[:at].count(stem) + 1}"
        for at, stem in enumerate(stems)
    ]
