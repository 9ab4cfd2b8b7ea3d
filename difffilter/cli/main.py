"""Parse, dispatch, and turn every error into one line on stderr."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from importlib.metadata import version

from difffilter.cli import bench, compare, export, report, run, scenarios, show, simulate, tune
from difffilter.cli.options import Parser
from difffilter.errors import DifffilterError

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
        args = _parser().parse_args(argv)
        code: int = args.command(args)
        sys.stdout.flush()
    except SystemExit as stop:  # argparse: after --help, --version or a wrong option
        return stop.code if isinstance(stop.code, int) else 0
    except DifffilterError as error:
        return _failed(" ".join(str(error).split()))
    except KeyboardInterrupt:
        print("difffilter: interrupted", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:
        # The reader has gone; keep the interpreter's last flush from complaining.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return BROKEN_PIPE
    except OSError as error:
        return _failed(f"{error.filename or 'output'}: {error.strerror or error}")
    except RuntimeError as error:
        reason = _beyond_the_machine(error)
        if not reason:
            raise
        return _failed(reason)
    return code


def _beyond_the_machine(error: RuntimeError) -> str:
    """What to say of an input that asks too much of torch; "" for any other error."""
    if type(error).__name__ == "_LinAlgError":  # torch is not imported here: that takes a second
        return (
            "a covariance cannot be factored: numbers too large or too small, "
            "expected sound times, noise levels and positions"
        )
    if "allocate memory" in str(error):
        return "not enough memory, expected fewer or shorter trajectories"
    return ""


def _failed(message: str) -> int:
    print(f"difffilter: error: {message}", file=sys.stderr)
    return WRONG_INPUT


def _parser() -> Parser:
    parser = Parser(
        "difffilter",
        "Robust Kalman-type filters, tuned by gradient, frozen, compared with published values.",
        EXAMPLE,
    )
    parser.add_argument(
        "--version", action="version", version=f"difffilter {version('difffilter')}"
    )
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for module in (scenarios, show, simulate, tune, compare, run, report, bench, export):
        module.add(commands)
    return parser
