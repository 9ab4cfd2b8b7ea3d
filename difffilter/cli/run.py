"""``difffilter run``: a frozen filter over a log."""

from __future__ import annotations

import math
from argparse import Namespace
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from difffilter.cli.logs import not_clairvoyant, note_missing_run
from difffilter.cli.options import (
    Commands,
    check_place,
    load_case,
    overrides,
    shows_progress,
    whole,
    with_overrides,
)
from difffilter.cli.output import note, print_json, say
from difffilter.cli.values import HELP, read_values, unfit
from difffilter.errors import InputError, shown

if TYPE_CHECKING:
    from collections.abc import Iterable

    from difffilter.cli.estimates import Tally
    from difffilter.logs.log import Log
    from difffilter.logs.times import Clock
    from difffilter.logs.track import Track
    from difffilter.scenario.case import Case
    from difffilter.scenario.checkpoint import Checkpoint

__all__ = ["add"]

EXAMPLE = """\
examples:
  difffilter run mine.json log.csv --out estimates.csv --plot track.png
  difffilter run mine.json log.csv --values published --out estimates.csv
  difffilter run uwb-ranges my.csv --run los_A1 --out estimates.csv --json
  difffilter run mine.json log.csv --smooth --out estimates.csv --plot track.png

The filter starts from the log's first measurements. Columns written: time, the states,
<state>_std, <channel>_weight (0 where missing), nis; of a mixture <mode>_probability; with
--smooth also <state>_smoothed and <state>_smoothed_std.
"""


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "run",
        help="run a checkpoint or a scenario's system over a log",
        description="Run a checkpoint, or a system of a scenario, over a recorded log.",
        example=EXAMPLE,
    )
    parser.add_argument(
        "source",
        metavar="CHECKPOINT_OR_SCENARIO",
        help="a .json checkpoint; a name or .toml file; MODULE:FUNCTION of --models",
    )
    parser.add_argument("log", metavar="LOG.csv", help="time, the channels, truth_<state> or not")
    parser.add_argument(
        "--values", metavar="VALUES", help=f"{HELP} (default: the checkpoint's, or published)"
    )
    parser.add_argument("--system", metavar="NAME", help="default: the one that is tuned")
    parser.add_argument("--run", metavar="NAME", help="which [runs] entry (the log's own name)")
    parser.add_argument(
        "--out", metavar="FILE", required=True, help="estimates to write: .csv, or .parquet"
    )
    parser.add_argument(
        "--covariance",
        action="store_true",
        help="write covariances too: cov_A_B of every two states",
    )
    parser.add_argument("--plot", metavar="FILE", help="figure to write, PNG and SVG")
    parser.add_argument(
        "--smooth",
        action="store_true",
        help="smoothed estimates too, from the whole log (held in memory)",
    )
    parser.add_argument(
        "--lag", type=float, metavar="S", help="--smooth from rows until so many seconds later only"
    )
    parser.add_argument(
        "--passes", type=whole(0), metavar="N", default=0,
        help="--smooth with weights anew from the smoothed residuals, so many times (0)",
    )  # fmt: skip
    parser.add_set()
    parser.add_models()
    parser.add_engine()
    parser.add_json()
    parser.add_quiet()
    parser.set_defaults(command=command)


@dataclass(frozen=True)
class Chosen:
    """What to run: a system of a scenario with values (None: the published ones)."""

    scenario: Case
    system: str
    label: str
    values: Checkpoint | None


def command(args: Namespace) -> int:
    """Run, write the estimates and the figure, print a summary."""
    check_place(args.out)
    check_place(args.plot)
    for option, given in (("lag", args.lag is not None), ("passes", args.passes > 0)):
        if given and not args.smooth:
            raise InputError(f"--{option}: found without --smooth, expected both")
    if Path(args.out).resolve() == Path(args.log).resolve():
        raise InputError(f"--out {args.out}: is the log itself, expected another file")
    asked = _chosen(args)
    chosen = _of_run(asked, args)

    from difffilter.cli.estimates import Tally, write_estimates
    from difffilter.filters.recipe import Recipe
    from difffilter.running.smoothing import check_smoothable
    from difffilter.running.windows import run_windows
    from difffilter.scenario.estimation import estimate, started
    from difffilter.scenario.scenario import Scenario

    log, clock = _read(chosen.scenario, args.log)
    system = chosen.scenario.system(chosen.system)
    frozen = chosen.values.values if chosen.values else None
    temperature = chosen.values.temperature if chosen.values else None
    if args.smooth:
        check_smoothable(system)
    ready = started(chosen.scenario, system, log, frozen)
    progress = shows_progress(args)
    settings = {"temperature": temperature, "progress": progress, "engine": args.engine}
    windows: Iterable[tuple[Log, Track]]
    later = None
    if isinstance(system, Recipe) and not args.plot and not args.smooth:
        windows = run_windows(system, ready, frozen, **settings)
    else:
        track = estimate(system, ready, frozen, **settings)
        windows = [(ready, track)]
        if args.smooth:
            later = _smoothed(chosen, ready, track, args)
    if isinstance(asked.scenario, Scenario):
        note_missing_run(asked.scenario, _run_name(args))
    tally = Tally(log, chosen.scenario.score)
    write_estimates(args.out, windows, clock, tally, args.covariance, later)
    result = tally.summary()
    for line in tally.warnings():
        note(line)
    if later is not None:
        again = Tally(log, chosen.scenario.score)
        again.add(later)
        result |= {"smoothed_rmse": again.summary()["rmse"], "lag": args.lag}
        result |= {"passes": args.passes}
    if args.plot:
        title = f"{chosen.scenario.name}, {chosen.system}, values {chosen.label}"
        _plot(args.plot, log, track, title, later)
    about = {"scenario": chosen.scenario.name, "system": chosen.system, "values": chosen.label}
    if args.json:
        print_json({**result, **about, "out": args.out})
    else:
        told = _text(result, log.truth is not None, tally)
        say(f"{chosen.scenario.name}, {chosen.system}, values {chosen.label}: {told}")
        say(f"estimates written to {args.out}")
    return 0


def _read(case: Case, path: str) -> tuple[Log, Clock]:
    """The log as a batch of one, and what its times mean; tells what was done to it."""
    from difffilter.logs.times import Clock
    from difffilter.scenario.recorded import read_run, stacked
    from difffilter.scenario.scenario import Scenario
    from difffilter.scenario.sources import as_log

    if not isinstance(case, Scenario):
        return as_log(case, [path]), Clock()
    read = read_run(case, path)
    for line in read.told:
        note(line)
    return stacked(case, [read]), read.clock


def _chosen(args: Namespace) -> Chosen:
    """The scenario, the system and the values that the arguments mean."""
    held: Checkpoint | None
    if Path(args.source).suffix == ".json":
        from difffilter.scenario.checkpoint import load

        stored = load(args.source)
        changes = overrides(args)
        scenario = with_overrides(stored.scenario, changes)
        label, own = args.values or args.source, stored.system
        held = read_values(label, scenario) if args.values else stored
        for key in changes:
            if held is not None and key.split(".")[0] == "parameters":
                raise InputError(f"--set {key}: the values are frozen, expected --values published")
    else:
        args.scenario = args.source
        scenario = load_case(args)
        label = args.values or "published"
        held = read_values(label, scenario)
        own = held.system if held else scenario.tuning.system
    system = args.system or own
    scenario.system(system)
    not_clairvoyant(scenario, system)
    problem = unfit(held, scenario, system) if held else ""
    if problem:
        raise InputError(f"values {label}: {problem}")
    return Chosen(scenario, system, label, held)


def _of_run(chosen: Chosen, args: Namespace) -> Chosen:
    """The choice with the geometry of the log's run."""
    from difffilter.scenario.recorded import scenario_of_run
    from difffilter.scenario.scenario import Scenario

    scenario = chosen.scenario
    if not isinstance(scenario, Scenario):
        if args.run:
            raise InputError(
                f"--run: found {args.run!r:.80}, expected none: {scenario.name} has none"
            )
        return chosen
    if args.run and args.run not in scenario.runs:
        expected = f"one of {', '.join(scenario.runs)}" if scenario.runs else "none: it has no runs"
        raise InputError(f"--run: found {shown(args.run)}, expected {expected}")
    name = _run_name(args)
    # The run's overrides are in; its name must not apply them again.
    return replace(chosen, scenario=replace(scenario_of_run(scenario, name), runs={}))


def _run_name(args: Namespace) -> str:
    return str(args.run or Path(args.log).stem)


def _smoothed(chosen: Chosen, log: Log, track: Track, args: Namespace) -> Track:
    """The track smoothed, with the values that it was made with."""
    from difffilter.running.smoothing import check_smoothable, smoothed

    system = check_smoothable(chosen.scenario.system(chosen.system))
    return smoothed(
        system,
        log.only(system.channels),
        track,
        chosen.values.values if chosen.values else None,
        lag=math.inf if args.lag is None else args.lag,
        passes=args.passes,
        temperature=chosen.values.temperature if chosen.values else None,
    )


def _plot(path: str, log: Log, track: Track, title: str, later: Track | None) -> None:
    from difffilter.reports.figures.style import save_figure
    from difffilter.reports.figures.tracks import track_figure

    save_figure(track_figure(log, track, title=title, smoothed=later), path)


def _text(result: dict[str, Any], truth: bool, tally: Tally) -> str:
    parts = [f"{result['rows']} row{'s' * (result['rows'] != 1)}"]
    if result["rmse"] is None:
        missing = "no row with truth that counts" if truth else "no truth"
        parts.append(f"{missing}, so no RMSE")
    else:
        parts.append(f"{tally.what} RMSE {result['rmse']:.4g} {tally.unit}".rstrip())
        if result.get("smoothed_rmse") is not None:
            parts.append(f"smoothed {result['smoothed_rmse']:.4g} {tally.unit}".rstrip())
    for name, share in result.get("isolated", {}).items():
        parts.append(f"{name} isolated as not finite in {100 * share:.1f} % of rows")
    from difffilter.scoring.metrics import REJECTED

    shares = [f"{name} {100 * share:.1f} %" for name, share in result["rejected"].items()]
    more = {n: error for n, error in result.get("states", {}).items() if n not in tally.states}
    if more:
        each = ", ".join(
            f"{name} {error:.4g} {tally.units[name]}".rstrip() for name, error in more.items()
        )
        parts[-1] += f"\nRMSE of other states: {each}"
    return f"{', '.join(parts)}\nrejected (weight below {REJECTED:g}): {', '.join(shares)}"
