"""Parse, dispatch, and turn every error into one line on stderr."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress
from io import TextIOWrapper
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from difffilter.cli.options import Parser

__all__ = ["main"]

WRONG_INPUT = 2
INTERRUPTED = 130  # 128 + SIGINT
BROKEN_PIPE = 141  # 128 + SIGPIPE

EXAMPLE = """\
examples:
  difffilter show airport-mlat
  difffilter tune airport-mlat --out mine.json
  difffilter compare airport-mlat --values published --values mine.json
  difffilter run mine.json log.csv --out estimates.csv

Every command has its own --help with an example.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """Run one command.

    Args:
        argv: arguments without the program's name; those of the process if None.

    Returns:
        Exit code: 0, 2 for wrong input, 130 after Ctrl-C.
    """
    try:
        return _run(argv)
    except KeyboardInterrupt:  # during the imports, too: they are within
        _say("difffilter: interrupted")
        return INTERRUPTED
    except BrokenPipeError:
        return _unread()


def _run(argv: Sequence[str] | None) -> int:
    """One command, with the errors that it raises told."""
    from difffilter.errors import DifffilterError

    if sys.stdout is None:
        return _failed("standard output is closed, expected it open")
    _write_anything()
    try:
        args = _parser().parse_args(argv)
        for path in getattr(args, "models", ()):
            from difffilter.scenario.own import load_models

            load_models(path)
        code: int = args.command(args)
        sys.stdout.flush()
    except SystemExit as stop:  # argparse: after --help, --version or a wrong option
        return stop.code if isinstance(stop.code, int) else 0
    except DifffilterError as error:
        return _failed(" ".join(str(error).split()))
    except BrokenPipeError:
        raise
    except OSError as error:
        return _failed(f"{error.filename or 'output'}: {error.strerror or error}")
    except (MemoryError, OverflowError, RuntimeError) as error:
        reason = _beyond_the_machine(error)
        if not reason:
            raise
        return _failed(reason)
    return code


def _write_anything() -> None:
    """A character that the terminal's encoding lacks is written as its number; nothing fails."""
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _unread() -> int:
    """The reader has gone: keep the interpreter's last flush from complaining."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return BROKEN_PIPE


def _beyond_the_machine(error: MemoryError | OverflowError | RuntimeError) -> str:
    """What to say of an input that asks too much of torch; "" for any other error."""
    if type(error).__name__ == "_LinAlgError":  # torch is not imported here: that takes a second
        return (
            "a covariance cannot be factored: numbers too large or too small, "
            "expected sound times, noise levels and positions"
        )
    large = isinstance(error, (MemoryError, OverflowError)) or "Storage size" in str(error)
    if large or "allocate memory" in str(error):
        return "not enough memory, expected fewer or shorter trajectories"
    return ""


def _failed(message: str) -> int:
    from difffilter.errors import printable

    _say(f"difffilter: error: {printable(message)}")
    return WRONG_INPUT


def _say(line: str) -> None:
    """A line on stderr; nothing where that is closed."""
    with suppress(OSError, ValueError):
        if sys.stderr is not None:
            print(line, file=sys.stderr)


def _parser() -> Parser:
    from difffilter.cli import (
        bench,
        compare,
        export,
        import_,
        inspect_,
        report,
        run,
        scenarios,
        show,
        simulate,
        tune,
    )  # fmt: skip
    from difffilter.cli.options import Parser, Version

    parser = Parser(
        "difffilter",
        "Robust Kalman-type filters, tuned by gradient, frozen, compared with published values.",
        EXAMPLE,
    )
    parser.add_argument("--version", action=Version, nargs=0, help="print the version and exit")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for module in (
        scenarios,
        show,
        simulate,
        import_,
        inspect_,
        tune,
        compare,
        run,
        report,
        bench,
        export,
    ):
        module.add(commands)
    return parser
