"""How the command-line tests call it: as a process, or in this one where that serves."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

from difffilter.cli.main import main

#: A scenario of the user's own, small enough for tests.
TINY = """\
schema = 1
extends = "airport-mlat"
name = "tiny"
title = "Twenty steps"

[world]
steps = 20

[tuning]
steps = 2
trajectories = 8
validation = 4
test = 4
batch = 4
"""
CHANNELS = [f"tdoa_{i}" for i in range(2, 9)]
STATES = ["x", "y", "vx", "vy"]


def environment() -> dict[str, str]:
    """One thread per process, so that tests can run side by side."""
    return os.environ | {"OMP_NUM_THREADS": "1"}


def process(*arguments: object, cwd: Path | None = None) -> subprocess.CompletedProcess[str]:
    """``python -m difffilter`` with these arguments."""
    return subprocess.run(
        [sys.executable, "-m", "difffilter", *map(str, arguments)],
        capture_output=True,
        text=True,
        timeout=400,
        cwd=cwd,
        env=environment(),
    )


def succeeds(*arguments: object, cwd: Path | None = None) -> str:
    """Standard output of a process that succeeds without a word on stderr."""
    done = process(*arguments, cwd=cwd)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return done.stdout


def fails(capsys: Any, *arguments: object) -> str:
    """The one line of a command that exits with 2 and prints nothing else."""
    capsys.readouterr()
    code = main([str(argument) for argument in arguments])
    printed = capsys.readouterr()
    check_failure(code, printed.out, printed.err)
    return printed.err


def check_failure(code: int, out: str, err: str) -> None:
    """Exit code 2, nothing on stdout, exactly one line on stderr."""
    assert code == 2, err
    assert out == ""
    assert err.startswith("difffilter: error: "), err
    assert err.endswith("\n")
    assert err.count("\n") == 1, err


def strict_json(text: str) -> Any:
    """Parse JSON, refusing NaN and infinity."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"found {constant} in JSON")

    return json.loads(text, parse_constant=refuse)


def read_columns(path: Path) -> dict[str, list[float | None]]:
    """A CSV file as columns; None for an empty field."""
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [float(row[name]) if row[name] else None for row in rows] for name in rows[0]}
