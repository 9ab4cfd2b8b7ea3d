"""``difffilter export``: a frozen filter as C99."""

from __future__ import annotations

import math
import re
from argparse import Namespace

from difffilter.cli.options import Commands
from difffilter.cli.output import say
from difffilter.errors import InputError, shown

__all__ = ["add"]

EXAMPLE = """\
examples:
  difffilter export mine.json --to c --out filter
  cd filter && cc -std=c99 -O2 airport_mlat.c airport_mlat_test.c -lm && ./a.out

Files: NAME.h, NAME.c, golden vectors and a self-test. No heap, no library but libm; compile
with -DNAME_FLOAT for float (exported with --float: -DNAME_DOUBLE for double).
"""


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "export",
        help="write a checkpoint's filter as C99",
        description="Write the frozen filter of a checkpoint as C99, with a self-test.",
        example=EXAMPLE,
    )
    parser.add_argument("checkpoint", metavar="CHECKPOINT", help="a .json checkpoint")
    parser.add_argument("--to", choices=("c",), required=True, help="language")
    parser.add_argument("--out", metavar="DIR", required=True, help="folder to write into")
    parser.add_argument("--name", metavar="NAME", help="of the files (the scenario's)")
    parser.add_argument(
        "--float", dest="single", action="store_true", help="compile in float by default"
    )
    parser.add_argument(
        "--origin",
        metavar="X,Y",
        help="coordinates in m that positions in C are relative to, one per axis: float has seven "
        "digits, too few for a national grid",
    )
    parser.add_models()
    parser.set_defaults(command=command)


def command(args: Namespace) -> int:
    """Write the files and name them."""
    if args.name is not None and not re.fullmatch(r"[A-Za-z]\w*", args.name, re.ASCII):
        raise InputError(f"--name: found {shown(args.name)}, expected ASCII letters, digits, _")

    from difffilter.export.c99 import export_c
    from difffilter.scenario.checkpoint import load

    origin = _origin(args.origin)
    for path in export_c(load(args.checkpoint), args.out, args.name, args.single, origin=origin):
        say(str(path))
    return 0


def _origin(text: str | None) -> tuple[float, ...]:
    """Coordinates; none without the option."""
    try:
        found = tuple(float(word) for word in text.split(",")) if text is not None else ()
    except ValueError:
        found = (math.nan,)
    if not all(map(math.isfinite, found)):
        raise InputError(f"--origin: found {text!r}, expected numbers in m: X,Y")
    return found
