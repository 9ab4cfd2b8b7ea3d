"""Mutated scenarios, checkpoints and logs: each loads, or is one line and exit code 2."""

from __future__ import annotations

import contextlib
import io
import random
import shutil
from pathlib import Path

from outcome import Tally, Violation

from difffilter.cli.main import main

__all__ = ["case"]

ROOT = Path(__file__).parents[2]
TOKENS = (
    b'"', b"'", b"[", b"]", b"{", b"}", b"=", b",", b"\n", b"\r\n", b"\0",
    b"\xff\xfe", b"\xef\xbb\xbf",
    b"1e309", b"-1e309", b"nan", b"inf", b"NaN", b"1e-320", b"9" * 400, b"0x10", b"true", b"-0.0",
    b"[" * 3000, b"\\ud800", b"\xed\xa0\x80", "\u202e".encode(), b"../../x", b"*/ system(0); /*",
    b"<script>", b"??/", b"\x1b[31m", b"1979-05-27T07:32:00Z", b"#", b";", b"1" * 23,
)  # fmt: skip


def case(seed: int, tally: Tally, folder: Path) -> None:
    """One mutated file through the commands that read it."""
    rng = random.Random(seed)
    kind = rng.choice(("scenario", "checkpoint", "log"))
    original = rng.choice(originals(kind, folder))
    data = _mutated(original.read_bytes(), rng)
    path = original.with_stem(f"mutant-of-{original.stem}")
    path.write_bytes(data)
    tally.counts[f"mutated files: {kind}"] += 1
    try:
        for command in _commands(kind, original.stem, path, folder):
            _command(command, tally)
        path.unlink()
    except Violation as error:
        kept = tally.out / f"documents-{seed}{original.suffix}"
        tally.out.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(data)
        tally.violation(
            "documents", seed, str(error), {"original": str(original), "file": kept.name}
        )


def originals(kind: str, folder: Path) -> list[Path]:
    if not (folder / "logs").exists():
        for name in ("scenarios", "checkpoints"):
            shutil.copytree(ROOT / name, folder / name)
        _simulated(folder / "logs")
    place, suffix = {
        "scenario": ("scenarios", "toml"),
        "checkpoint": ("checkpoints", "json"),
        "log": ("logs", "csv"),
    }[kind]
    return [
        path for path in sorted((folder / place).glob(f"*.{suffix}")) if "mutant" not in path.stem
    ]


def _simulated(folder: Path) -> None:
    for name in ("airport-mlat", "airborne-bearing-absolute", "uwb-simulated"):
        place = str(folder / f"{name}.csv")
        with contextlib.redirect_stdout(io.StringIO()):
            main(["simulate", name, "--trajectories", "1", "--seed", "3", "--out", place])


def _mutated(data: bytes, rng: random.Random) -> bytes:
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        lines = data.split(b"\n")
        at = rng.randrange(max(1, len(data)))
        kind = rng.choice((0, 1, 2, 3, 4, 5, 6, 7, 7, 7))
        if kind == 0:  # flip a bit
            data = (
                data[:at] + bytes([data[at] ^ (1 << rng.randrange(8))]) + data[at + 1 :]
                if data
                else b"x"
            )
        elif kind == 1:  # cut
            data = data[:at]
        elif kind == 2:  # a line twice
            i = rng.randrange(len(lines))
            data = b"\n".join([*lines[: i + 1], lines[i], *lines[i + 1 :]])
        elif kind == 3:  # a line less
            i = rng.randrange(len(lines))
            data = b"\n".join(lines[:i] + lines[i + 1 :])
        elif kind == 4:  # two lines changed over
            i, j = rng.randrange(len(lines)), rng.randrange(len(lines))
            lines[i], lines[j] = lines[j], lines[i]
            data = b"\n".join(lines)
        elif kind == 5:  # a token in
            data = data[:at] + rng.choice(TOKENS) + data[at:]
        elif kind == 7:  # other digits
            digits = [i for i, byte in enumerate(data) if 48 <= byte <= 57]
            for i in rng.sample(digits, min(3, len(digits))):
                data = data[:i] + b"%d" % rng.randrange(10) + data[i + 1 :]
        else:  # a number or word replaced
            end = at
            while end < len(data) and data[end : end + 1].isalnum():
                end += 1
            data = data[:at] + rng.choice(TOKENS) + data[end:]
    return data


def _commands(kind: str, stem: str, path: Path, folder: Path) -> list[list[str]]:
    out = folder / "out"
    if kind == "scenario":
        small = ["--set", "world.steps=5"]
        return [
            ["show", str(path)],
            ["simulate", str(path), *small, "--trajectories", "1", "--out", str(out)],
        ]
    if kind == "checkpoint":
        return [["export", str(path), "--to", "c", "--out", str(out / "c")]]
    return [["run", stem, str(path), "--out", str(out / "estimates.csv")]]


def _command(command: list[str], tally: Tally) -> None:
    out, err = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            code = main(command)
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        raise Violation(f"{command[0]}: traceback {type(error).__name__}: {error}"[:300]) from error
    tally.counts[f"exit code {code}"] += 1
    said = err.getvalue()
    if code not in (0, 2):
        raise Violation(f"{command[0]}: exit code {code}: {said[:200]}")
    if code == 2 and (not said.startswith("difffilter: error:") or said.count("\n") != 1):
        raise Violation(f"{command[0]}: exit code 2 without its one line: {said[:200]!r}")
    if len(said) > 2000:
        raise Violation(f"{command[0]}: a line of {len(said)} characters")
    if any(c in said for c in "\x1b\0\u202e") or any(c in out.getvalue() for c in "\x1b\0\u202e"):
        raise Violation(f"{command[0]}: control characters of the file reach the terminal")
