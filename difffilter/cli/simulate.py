"""``difffilter simulate``: logs with truth."""

from __future__ import annotations

import os
import shutil
from argparse import Namespace
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from difffilter.cli.options import Commands, check_place, load_named, whole
from difffilter.cli.output import print_json, say
from difffilter.errors import InputError

if TYPE_CHECKING:
    from difffilter.logs.log import Log
    from difffilter.scenario.scenario import Scenario

__all__ = ["add"]

#: Rows that are simulated at once.
PART = 1_000_000
#: Bytes that a number takes in a CSV file, at least.
NUMBER = 8
#: First line of a log that is to be read as it is: without [log], whatever a fault made of it.
MARKED = "1, SI units, simulated"
EXAMPLE = """\
examples:
  difffilter simulate airport-mlat --trajectories 100 --seed 7 --out logs
  difffilter simulate airport-mlat --trajectories 1 --out log.csv --set faults.nlos.scale=50

A folder gets SCENARIO-SEED-0000.csv and so on. difffilter run, compare --log and
tune --log read the files; their trajectories are none of those that tune and compare draw.
"""


def add(commands: Commands) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "simulate",
        help="write simulated logs with truth",
        description="Write simulated logs with truth, one CSV file per trajectory.",
        example=EXAMPLE,
    )
    parser.add_scenario()
    parser.add_argument("--trajectories", type=whole(1), default=100, help="how many (100)")
    parser.add_seed(0, "same seed, same logs")
    parser.add_argument(
        "--out", metavar="DIR_OR_FILE", required=True, help="folder, or a .csv for one trajectory"
    )
    parser.add_json()
    parser.add_quiet()
    parser.set_defaults(command=command)


def command(args: Namespace) -> int:
    """Simulate and write."""
    single = Path(args.out).suffix == ".csv"
    if single and args.trajectories > 1:
        raise InputError(
            f"--out {args.out}: found one file for {args.trajectories} trajectories, "
            "expected a folder (or --trajectories 1)"
        )
    scenario = load_named(args)

    from difffilter.logs.logfile import write_log
    from difffilter.scenario.simulation import simulate

    world = scenario.world
    part = max(1, PART // world.steps) if world else args.trajectories
    _check_memory(scenario, min(part, args.trajectories))
    folder = Path(args.out)

    def place(i: int) -> Path:
        return folder if single else folder / f"{scenario.name}-{args.seed}-{i:04d}.csv"

    check_place(str(place(0)))
    _check_disk(scenario, args.trajectories, folder)
    for first in range(0, args.trajectories, part):
        places = [place(i) for i in range(first, min(first + part, args.trajectories))]
        # A part has a stream of its own; the first one is what difffilter.simulate draws.
        purpose = f"log {first // part}" if first else "log"
        log = simulate(scenario, len(places), args.seed, purpose)
        if log.truth is not None and not bool(log.truth.isfinite().all()):
            raise InputError(
                f"{scenario.name}: the simulated truth is not finite, expected a world of moderate "
                "numbers (world.dt, world.position, world.velocity, world.acceleration)"
            )
        mark = MARKED if scenario.log or _beyond(scenario, log) else ""
        for i, path in enumerate(places):
            write_log(path, _one(log, i), mark)
    if args.json:
        print_json(
            {
                "scenario": scenario.name,
                "trajectories": args.trajectories,
                "seed": args.seed,
                "rows": log.steps,
                "files": [str(place(i)) for i in range(args.trajectories)],
            }
        )
    else:
        count = "1 log" if args.trajectories == 1 else f"{args.trajectories} logs"
        say(f"{scenario.name}: {count} of {log.steps} rows with truth in {args.out}")
    return 0


def _check_memory(scenario: Scenario, trajectories: int) -> None:
    """Raise InputError, before it is taken, for more memory than there is."""
    if scenario.world is None:
        return
    numbers = 6 * scenario.axes + 12 * len(scenario.channels)  # at the peak, per row
    needed = 8 * numbers * scenario.world.steps * trajectories
    free = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    if needed > free:
        raise InputError(
            f"--trajectories {trajectories}: {scenario.world.steps} rows each need about "
            f"{needed / 1e9:.3g} GB of memory, found {free / 1e9:.3g} GB free: expected fewer or "
            "shorter trajectories"
        )


def _check_disk(scenario: Scenario, trajectories: int, folder: Path) -> None:
    """Raise InputError, before anything is written, for more files than the disk takes."""
    if scenario.world is None:
        return
    columns = 1 + 2 * scenario.axes + len(scenario.channels)
    needed = NUMBER * columns * scenario.world.steps * trajectories
    there = next(place for place in (folder, *folder.absolute().parents) if place.is_dir())
    free = shutil.disk_usage(there).free
    if needed > free:
        raise InputError(
            f"--trajectories {trajectories}: {scenario.world.steps} rows each need about "
            f"{needed / 1e9:.3g} GB of disk, found {free / 1e9:.3g} GB free at {there}: expected "
            "fewer or shorter trajectories"
        )


def _beyond(scenario: Scenario, log: Log) -> bool:
    """Whether a simulated fault gives what no device would: a range of 0, say."""
    from difffilter.scenario.recorded import bounds

    limits = bounds(scenario)
    columns = zip(log.channels, log.z.unbind(-1), strict=True)
    return any(
        bool(((z <= limits[name].low) | (z > limits[name].high)).any())
        for name, z in columns if name in limits
    )  # fmt: skip


def _one(log: Log, i: int) -> Log:
    """One trajectory of a batch, without the batch's dimension."""
    return replace(
        log,
        time=log.time if log.time.dim() == 1 else log.time[:, i],
        z=log.z[:, i],
        truth=None if log.truth is None else log.truth[:, i],
        inputs={name: value[:, i] for name, value in log.inputs.items()},
        start=None,
        names=(),
    )
