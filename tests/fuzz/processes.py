"""Kills and resumes, full and missing disks, damaged caches: whole results or one line."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
from pathlib import Path

from outcome import Tally, Violation

__all__ = ["cache", "disk", "kill"]

SMALL = [
    "airport-mlat", "--set", "world.steps=10", "--set", "tuning.validation=4",
    "--set", "tuning.test=4",
    "--set", "tuning.optimiser=adam", "--trajectories", "8", "--quiet", "--engine", "torch",
]  # fmt: skip
LIMIT = 120


def _process(args: list[str], **environment: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "difffilter", *args],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"OMP_NUM_THREADS": "1"} | environment,
    )


def _end(process: subprocess.Popen[str]) -> tuple[int, str]:
    try:
        _, said = process.communicate(timeout=LIMIT)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        raise Violation("a command that does not end") from None
    return process.returncode, said


def kill(seed: int, tally: Tally, folder: Path) -> None:
    """A tuning killed at a random moment: nothing half-written, and it resumes."""
    rng = random.Random(seed)
    place = folder / f"kill-{seed}"
    place.mkdir()
    out = place / "x.json"
    tune = ["tune", *SMALL, "--steps", "60", "--out", str(out)]
    try:
        process = _process(tune)
        try:
            process.communicate(timeout=rng.uniform(1.5, 6.0))
        except subprocess.TimeoutExpired:
            process.send_signal(rng.choice((signal.SIGKILL, signal.SIGTERM, signal.SIGINT)))
            process.communicate()
        tally.counts["kills"] += 1
        resume = ["--resume"] if (place / "x.state.pt").exists() else []
        code, said = _end(_process([*tune, *resume]))
        if code != 0:
            raise Violation(f"resume: exit code {code}: {said[:200]}")
        tally.counts["resumes"] += bool(resume)
        left = sorted(path.name for path in place.iterdir())
        if left != ["x.json"]:
            raise Violation(f"left behind: {', '.join(left)}")
        code, said = _end(_process(["show", str(out)]))
        if code != 0:
            raise Violation(f"show of the result: {said[:200]}")
    except Violation as error:
        tally.violation("kill", seed, str(error), {"command": tune})
    finally:
        shutil.rmtree(place, ignore_errors=True)


def disk(seed: int, tally: Tally, folder: Path) -> None:
    """Results into places that take none: a full device, a file for a folder, no folder."""
    rng = random.Random(seed)
    blocker = folder / "file"
    blocker.write_text("x")
    place = rng.choice(
        ("/dev/full", str(blocker / "x"), "/proc/x", str(folder / "no" / "such" / "x"))
    )
    command = rng.choice(
        (
            ["tune", *SMALL, "--steps", "2", "--out", f"{place}.json"],
            [
                "simulate",
                "airport-mlat",
                "--set",
                "world.steps=5",
                "--trajectories",
                "1",
                "--out",
                place,
            ],
            ["show", "airport-mlat", "--out", place],
        )
    )
    tally.counts["bad places"] += 1
    try:
        code, said = _end(_process(command))
        if "Traceback" in said or code not in (0, 2):
            raise Violation(f"{command[0]} into {place}: exit code {code}: {said[-200:]}")
    except Violation as error:
        tally.violation("disk", seed, str(error), {"command": command})


def cache(seed: int, tally: Tally, folder: Path) -> None:
    """A damaged cache of compiled steps is rebuilt: the same estimates, whatever is in it."""
    rng = random.Random(seed)
    place = folder / "cache"
    log = sorted((folder / "logs").glob("airport*.csv"))[0]
    out = folder / "estimates.csv"
    command = [
        "run",
        "airport-mlat",
        str(log),
        "--system",
        "ekf",
        "--engine",
        "fused",
        "--out",
        str(out),
    ]
    try:
        code, said = _end(_process(command, DIFFFILTER_CACHE=str(place)))
        if code != 0:
            raise Violation(f"run with a fresh cache: {said[:200]}")
        expected = out.read_bytes()
        files = [path for path in place.rglob("*") if path.is_file()]
        damaged = rng.choice(files)
        data = damaged.read_bytes()
        kind = rng.randrange(4)
        if kind == 0:
            damaged.write_bytes(b"")
        elif kind == 1:
            damaged.write_bytes(data[: rng.randrange(len(data) + 1)])
        elif kind == 2:
            at = rng.randrange(max(1, len(data)))
            damaged.write_bytes(data[:at] + os.urandom(64) + data[at + 64 :])
        else:
            damaged.unlink()
        tally.counts["damaged caches"] += 1
        code, said = _end(_process(command, DIFFFILTER_CACHE=str(place)))
        if code != 0:
            raise Violation(f"damage {kind} of {damaged.name}: exit code {code}: {said[:200]}")
        if out.read_bytes() != expected:
            raise Violation(f"damage {kind} of {damaged.name}: other estimates")
    except Violation as error:
        tally.violation("cache", seed, str(error), {"command": command})
