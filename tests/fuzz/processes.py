"""Kills and resumes, full and read-only disks, damaged caches: whole results or one line."""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import time
from functools import cache as once
from pathlib import Path

from commands import Command, aged, whole
from outcome import Tally, Violation

__all__ = ["cache", "disk", "kill"]

WORLD = ["airport-mlat", "--set", "world.steps=4"]
TUNE = [
    "tune", *WORLD, "--system", "ekf", "--set", "tuning.validation=2", "--set", "tuning.test=2",
    "--set", "tuning.optimiser=adam", "--trajectories", "2", "--steps", "8", "--quiet",
    "--engine", "torch", "--out", "x.json", "--set", "tuning.learning_rate=0.3",
    "--set", "tuning.evaluate_every=2", "--set", "parameters.tdoa.sigma.value=200.0",
]  # fmt: skip
SEARCH = [word.replace("=adam", "=random") for word in TUNE]
SIMULATE = ["simulate", *WORLD, "--trajectories", "40", "--seed", "3", "--quiet", "--out", "x"]
RUN = ["run", "airport-mlat", "log.csv", "--system", "ekf", "--engine", "torch", "--out", "x.csv"]
SIGNALS = (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT)


def _at(place: Path, args: list[str], disk: str = "", **environment: str) -> Command:
    """The command with its files in a folder; what it says goes beside that."""
    out = ("x", "x.json", "x.csv", "log.csv")
    words = [str(place / word) if word in out else word for word in args]
    return Command(words, place.with_suffix(".said"), environment, disk)


def _log(folder: Path) -> Path:
    return sorted((folder / "logs").glob("airport*.csv"))[0]


@once
def _undisturbed(args: tuple[str, ...], folder: Path) -> tuple[float, dict[str, bytes]]:
    """How long a command takes, and the files that it writes."""
    place = folder / f"undisturbed-{abs(hash(args))}"
    place.mkdir()
    shutil.copy(_log(folder), place / "log.csv")
    begun = time.monotonic()
    _at(place, list(args)).sound(0)
    seconds = time.monotonic() - begun
    if args[0] == "tune":
        _moved(place / "x.json")
    return seconds, _files(place)


def _moved(path: Path) -> None:
    """Tuning must move its values: runs that all keep the published ones are equal for nothing."""
    parameters = json.loads(path.read_text())["parameters"].values()
    if not any(p["tuned"] and p["value"] != p["published"] for p in parameters):
        raise Violation("tune: no value moved")


def _files(place: Path) -> dict[str, bytes]:
    found = {}
    for path in sorted(place.rglob("*")):
        if path.is_file() and path.name != "log.csv":
            found[str(path.relative_to(place))] = _lasting(path)
    return found


def _lasting(path: Path) -> bytes:
    """What is the same in each run: a checkpoint without the time that it took."""
    data = path.read_bytes()
    if path.suffix != ".json":
        return data
    read = json.loads(data)
    kept = ("parameters", "values", "system", "temperature", "recipe", "result", "document")
    return json.dumps({key: read.get(key) for key in kept}).encode()


def kill(seed: int, tally: Tally, folder: Path) -> None:
    """A command killed at random moments leaves nothing half-written; it ends as if undisturbed."""
    rng = random.Random(seed)
    place = folder / f"kill-{seed}"
    place.mkdir()
    shutil.copy(_log(folder), place / "log.csv")
    args = rng.choice((TUNE, TUNE, TUNE, SEARCH, SIMULATE, RUN))
    command = _at(place, args)
    state = place / "x.state.pt"
    try:
        seconds, expected = _undisturbed(tuple(args), folder)
        for _ in range(rng.choice((1, 2, 3))):
            if command.killed(rng.uniform(0.0, seconds), rng.choice(SIGNALS)):
                tally.counts["kills"] += 1
            half = [p.name for p in place.iterdir() if p.name[0] != "." and not whole(p)]
            if half:
                raise Violation(f"half-written: {', '.join(half)}")
            if state.exists() and "--resume" not in command.args:
                command.args.append("--resume")
            elif not state.exists() and "--resume" in command.args:
                command.args.remove("--resume")
        aged(place)
        if state.exists() and rng.random() < 0.2:
            _damaged_state(command, state, rng, tally)
        command.sound(0)
        tally.counts["resumes"] += "--resume" in command.args
        _compare(expected, _files(place))
    except Violation as error:
        tally.violation("kill", seed, str(error), {"command": command.args})
    finally:
        shutil.rmtree(place, ignore_errors=True)


def _damaged_state(command: Command, state: Path, rng: random.Random, tally: Tally) -> None:
    """A state with other bytes is refused by name, and the run starts anew without it."""
    data = bytearray(state.read_bytes())
    at = rng.randrange(len(data))
    data[at] ^= 1 << rng.randrange(8)
    state.write_bytes(data if rng.random() < 0.5 else data[:at])
    tally.counts["damaged states"] += 1
    command.sound(2)
    state.unlink()
    command.args.remove("--resume")


def _compare(expected: dict[str, bytes], found: dict[str, bytes]) -> None:
    if sorted(found) != sorted(expected):
        raise Violation(f"files: found {sorted(found)[:5]}, expected {sorted(expected)[:5]}")
    other = [name for name in expected if found[name] != expected[name]]
    if other:
        raise Violation(f"other contents than undisturbed: {', '.join(other[:5])}")


def disk(seed: int, tally: Tally, folder: Path) -> None:
    """Results onto a full or read-only disk, or into no place: whole, or one line and nothing."""
    rng = random.Random(seed)
    place = folder / "disk"
    place.mkdir(exist_ok=True)
    args = rng.choice((TUNE, SEARCH, SIMULATE, RUN))
    args = [word if word != "8" else "3" for word in args]
    args = [word if word != "log.csv" else str(_log(folder)) for word in args]
    options = rng.choice(("ro", "size=4k", "size=8k", "size=16k", "size=32k", "size=64k"))
    command = _at(place, args, f"{place}:{options}", DIFFFILTER_CACHE=str(place / "cache"))
    if rng.random() < 0.3:  # the cache alone is there: results are written elsewhere
        beside = folder / "disk-beside"
        shutil.rmtree(beside, ignore_errors=True)
        beside.mkdir()
        command = _at(beside, args, f"{place}:{options}", DIFFFILTER_CACHE=str(place / "cache"))
        command.args = [word if word != "torch" else "auto" for word in command.args]
        codes: tuple[int, ...] = (0,)
    else:
        codes = (0, 2)
        if rng.random() < 0.2:
            blocker = folder / "file"
            blocker.write_text("x")
            command = _at(rng.choice((blocker, Path("/proc/x"), Path("/dev/full"))), args)
            command.log, codes = folder / "disk.said", (2,)
    tally.counts["full and read-only disks"] += 1
    try:
        command.sound(*codes)
        left = command.log.with_suffix(".left")
        if left.exists():
            found = json.loads(left.read_text())
            left.unlink()
            half = [name for name, complete in found.items() if not complete]
            if half:
                raise Violation(f"{args[0]}, disk {options}: half-written {', '.join(half)}")
    except Violation as error:
        tally.violation("disk", seed, str(error), {"command": command.args, "disk": command.disk})


def cache(seed: int, tally: Tally, folder: Path) -> None:
    """A damaged cache of compiled steps is rebuilt: the same estimates, whatever is in it."""
    rng = random.Random(seed)
    place, damaged_place = folder / "cache", folder / "cache-damaged"
    args = [word if word != "log.csv" else str(_log(folder)) for word in RUN]
    args[args.index("torch")] = rng.choice(("fused", "auto"))
    fresh = folder / "cache-run"
    fresh.mkdir(exist_ok=True)
    try:
        _at(fresh, args, DIFFFILTER_CACHE=str(place)).sound(0)
        expected = (fresh / "x.csv").read_bytes()
        shutil.rmtree(damaged_place, ignore_errors=True)
        shutil.copytree(place, damaged_place)
        kinds = [_damage(damaged_place, rng) for _ in range(rng.choice((1, 1, 2, 4)))]
        tally.counts["damaged caches"] += 1
        _at(fresh, args, DIFFFILTER_CACHE=str(damaged_place)).sound(0)
        if (fresh / "x.csv").read_bytes() != expected:
            raise Violation(f"{', '.join(kinds)}: other estimates")
    except Violation as error:
        tally.violation("cache", seed, str(error), {"command": args})


def _damage(place: Path, rng: random.Random) -> str:
    """One file of a cache emptied, cut, written over, removed or put in another's place."""
    files = sorted(path for path in place.rglob("*") if path.is_file())
    if not files:
        return "nothing"
    path, kind = rng.choice(files), rng.randrange(6)
    data = path.read_bytes()
    at = rng.randrange(len(data) + 1)
    if kind == 0:
        path.write_bytes(b"")
    elif kind == 1:
        path.write_bytes(data[:at])
    elif kind == 2:
        path.write_bytes(data[:at] + os.urandom(64) + data[at + 64 :])
    elif kind == 3:
        path.unlink()
        path.mkdir()
    elif kind == 4:
        path.write_bytes(rng.choice(files).read_bytes() if path.is_file() else b"")
    else:
        path.unlink()
    return f"damage {kind} of {path.name}"
