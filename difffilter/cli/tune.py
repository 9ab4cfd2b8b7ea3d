"""``difffilter tune``: tune by gradient, freeze, compare on held-out data."""

from __future__ import annotations

import os
import shlex
import signal
import sys
from argparse import Namespace
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difffilter.cli.logs import need_log, not_clairvoyant, read_logs
from difffilter.cli.options import (
    Commands,
    check_place,
    load_case,
    named_weight,
    shows_progress,
    whole,
)
from difffilter.cli.output import aside, comparison_text, number, print_json, say, table
from difffilter.errors import InputError, RankError

if TYPE_CHECKING:
    from difffilter.scenario.checkpoint import Checkpoint
    from difffilter.tuning.loop import TuneResult

__all__ = ["add"]

EXAMPLE = """\
examples:
  difffilter tune airport-mlat --out mine.json --tensorboard board
  difffilter tune airport-mlat --out mine.json --tensorboard board --resume
  difffilter tune uwb-ranges --log los_A1.csv nlos_A1.csv --test-log los_A2.csv nlos_A2.csv
  difffilter tune airport-mlat --loss likelihood=1 --loss innovation-consistency=0.1

What is tuned: the parameters with "tuned = true" in the scenario (see difffilter show).
"""


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "tune",
        help="tune a system by gradient and freeze it",
        description="Tune a system's parameters by gradient, freeze them into a checkpoint and "
        "compare it with the published values on held-out data.",
        example=EXAMPLE,
    )
    parser.add_scenario(models=True)
    parser.add_argument(
        "--log", metavar="FILE", nargs="+", help="recorded logs to train on, instead of simulation"
    )
    parser.add_argument(
        "--validation-log", metavar="FILE", nargs="+",
        help="recorded logs that choose among the steps (a part of --log that is held back)",
    )  # fmt: skip
    parser.add_argument("--test-log", metavar="FILE", nargs="+", help="recorded logs to test on")
    parser.add_argument("--trajectories", type=whole(1), help="simulated ones to train on")
    parser.add_seed(0, "of everything random")
    parser.add_argument("--steps", type=whole(1), help="gradient steps at most, per start")
    parser.add_argument("--starts", type=whole(1), help="starts; the first: published values")
    parser.add_argument("--system", metavar="NAME", help="default: the scenario's")
    parser.add_argument(
        "--tuned", metavar="NAME", action="append",
        help="a parameter to tune, or a pattern, in place of those declared so (repeatable)",
    )  # fmt: skip
    parser.add_argument(
        "--loss",
        metavar="NAME=WEIGHT",
        type=named_weight,
        action="append",
        help="replaces the scenario's loss (repeatable)",
    )
    parser.add_argument("--out", metavar="FILE", help="checkpoint (runs/SCENARIO.json)")
    parser.add_argument("--tensorboard", metavar="DIR", help="folder for TensorBoard")
    parser.add_argument("--resume", action="store_true", help="go on where a run was interrupted")
    parser.add_engine()
    parser.add_json()
    parser.add_quiet()
    parser.set_defaults(command=command)


def command(args: Namespace) -> int:
    """Tune, print, and say how to resume after Ctrl-C."""
    check_place(args.out, (".json",))
    if args.log and args.trajectories is not None:
        raise InputError("--trajectories: found beside --log, expected one of them")
    scenario = load_case(args, _settings(args))
    out = args.out or f"runs/{scenario.name}.json"
    check_place(out)
    log, test = read_logs(scenario, args.log), read_logs(scenario, args.test_log)
    validation = read_logs(scenario, args.validation_log)
    need_log(scenario, log)
    if log is not None:
        not_clairvoyant(scenario, scenario.tuning.system)

    from difffilter.tuning.loop import tune
    from difffilter.tuning.state import state_path

    try:
        result = tune(
            scenario,
            seed=args.seed,
            train=log,
            validation=validation,
            tuned=args.tuned,
            test=test,
            out=out,
            tensorboard=args.tensorboard,
            resume=args.resume,
            progress=shows_progress(args),
            engine=args.engine,
        )
    except KeyboardInterrupt:
        aside(f"interrupted; {_how_to_resume(state_path(out))}")
        return 130
    except RankError as error:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # it is ending already
        if int(os.environ.get("RANK", "0")) > 1:  # one line is enough
            return 2
        kept = "go on with --resume" if state_path(out).is_file() else "nothing was saved yet"
        raise RankError(f"{error}; {kept}") from None
    if not result.first:
        return 0
    if args.json:
        print_json(_data(result, out, args.seed))
    else:
        say(_text(result, out))
    return 0


def _settings(args: Namespace) -> dict[str, Any]:
    """Options as overrides of ``[tuning]``: checked with it, and kept in the checkpoint."""
    options = {
        "system": args.system,
        "loss": None if args.loss is None else dict(args.loss),
        "trajectories": args.trajectories,
        "steps": args.steps,
        "starts": args.starts,
    }
    return {f"tuning.{name}": value for name, value in options.items() if value is not None}


def _how_to_resume(state: Path) -> str:
    if not state.is_file():
        return "nothing was saved yet, so there is nothing to resume"
    given = [word for word in sys.argv[1:] if word != "--resume"]
    return f"go on with: {shlex.join(['difffilter', *given, '--resume'])}"


def _entries(checkpoint: Checkpoint) -> list[tuple[str, float, float, str]]:
    """Every tuned number: name, published, tuned, unit."""
    found = []
    for name, parameter in checkpoint.published_filter.declarations.items():
        if parameter.tuned:
            before = parameter.tensor().reshape(-1).tolist()
            after = checkpoint.values[name].reshape(-1).tolist()
            for entry, old, new in zip(parameter.entries(), before, after, strict=True):
                found.append((entry, old, new, parameter.unit))
    return found


def _shown_units(checkpoint: Checkpoint) -> dict[str, tuple[str, float]]:
    """Unit that each number was given in, and its factor to SI."""
    declared = checkpoint.published_filter.declarations.values()
    return {entry: parameter.shown for parameter in declared for entry in parameter.entries()}


def _data(result: TuneResult, out: str, seed: int) -> dict[str, Any]:
    checkpoint = result.checkpoint
    errors = checkpoint.training.get("standard_errors", {})
    return {
        "scenario": checkpoint.scenario.name,
        "system": checkpoint.system,
        "seed": seed,
        "checkpoint": out,
        "values": {
            entry: {
                "published": old,
                "tuned": new,
                "unit": unit,
                "standard_error": errors.get(entry),
            }
            for entry, old, new, unit in _entries(checkpoint)
        },
        "training": checkpoint.training,
        "held_out": None if result.held_out is None else result.held_out.as_dict(),
    }


def _error(entry: str, training: Mapping[str, Any], factor: float) -> str:
    """A standard error; "free" where the data do not determine the value."""
    errors: Mapping[str, float | None] = training.get("standard_errors", {})
    if entry not in errors:
        return ""
    value = errors[entry]
    if value is not None:
        return number(value / factor)
    told = [line for line in training.get("undetermined", ()) if "the data" in line]
    return "free" if any(entry in line for line in told) else "unknown"


def _ended(training: Mapping[str, Any]) -> list[str]:
    """What is to be known of how the tuning ended, and of what chose among its steps."""
    lines = [f"warning: {line}" for line in training.get("undetermined", ())]
    end = training.get("end")
    if end in ("steps", "runs"):
        cap = "steps" if end == "steps" else "filter runs"
        limit = training["settings"][end]
        lines.append(f"warning: ended at its cap of {limit:g} {cap}, before it converged")
    guards = training.get("guards")
    if guards is not None and guards["share"] < 1.0:
        lines.append(
            f"held to its guards: {guards['share']:g} of the way from the published values, since "
            f"world {guards['worst']} would err by up to {guards['upper']:.3f} of published"
        )
    if "validation" in training:
        lines.append(f"validated on what was {training['validation']}")
    return lines


def _text(result: TuneResult, out: str) -> str:
    checkpoint = result.checkpoint
    shown = _shown_units(checkpoint)
    rows = (
        [
            entry, number(old / shown[entry][1]), "->", number(new / shown[entry][1]),
            _error(entry, checkpoint.training, shown[entry][1]), shown[entry][0],
        ]
        for entry, old, new, _ in _entries(checkpoint)
    )  # fmt: skip
    title = f"{checkpoint.scenario.name}, {checkpoint.system}"
    head = ["parameter", "before", "", "after", "standard error", "unit"]
    lines = [f"{title}: tuned values", table(head, rows)]
    lines += _ended(checkpoint.training)
    if checkpoint.training["step"] == 0 and checkpoint.training["start"] == 0:
        lines.append("Nothing beat the published values on the validation data; they are kept.")
    if result.held_out is None:
        lines.append("\nNo held-out data with truth, so no comparison.")
    else:
        lines.append(f"\nHeld out\n\n{comparison_text(result.held_out, checkpoint.scenario)}")
    lines.append(f"checkpoint written to {out}")
    return "\n".join(lines)
