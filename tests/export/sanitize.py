"""Runs the self-test of every exported checkpoint under AddressSanitizer and UBSan.

python tests/export/sanitize.py [CHECKPOINT.json ...]      # make sanitize

A line for each checkpoint and precision, report/sanitize.json; exit code 1 if one is not clean.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

from difffilter.export.c99 import export_c
from difffilter.scenario.checkpoint import load

CHECKPOINTS = Path(__file__).parents[2] / "checkpoints"
RESULT = Path("report") / "sanitize.json"
CC = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
STRICT = ["-std=c99", "-g", "-O1", "-Wall", "-Wextra", "-Werror", "-pedantic"]
SANITIZERS = [
    "-fsanitize=address,undefined,float-divide-by-zero,float-cast-overflow",
    "-fno-sanitize-recover=all",
    "-fno-omit-frame-pointer",
]


def available() -> bool:
    """Whether there is a compiler with both sanitizers."""
    if CC is None:
        return False
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "a.c").write_text("int main(void) { return 0; }\n")
        command = [CC, *SANITIZERS, "a.c", "-o", "a"]
        made = subprocess.run(command, cwd=folder, capture_output=True, check=False)
        return made.returncode == 0 and subprocess.run([Path(folder) / "a"]).returncode == 0


def said(folder: Path, name: str, flags: Sequence[str] = ()) -> str:
    """What the sanitized self-test of exported C says wrong; "" where it is clean."""
    files = [f"{name}.c", f"{name}_test.c"]
    command = [str(CC), *STRICT, *SANITIZERS, *flags, *files, "-o", "check", "-lm"]
    made = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    if made.returncode:
        return made.stderr or "does not compile"
    done = subprocess.run(["./check"], cwd=folder, capture_output=True, text=True, check=False)
    return "" if done.returncode == 0 else done.stderr + done.stdout


def sanitized(checkpoint: Path) -> Iterator[tuple[str, str]]:
    """Each precision, and what is wrong in it."""
    with tempfile.TemporaryDirectory() as folder:
        export_c(load(checkpoint), folder, "one")
        for precision, flags in (("double", []), ("float", ["-DONE_FLOAT"])):
            yield precision, said(Path(folder), "one", flags)


def main(paths: Sequence[str]) -> int:
    """Every checkpoint, in both precisions."""
    if not available():
        print("found no compiler with AddressSanitizer and UBSan, expected gcc or clang")
        return 2
    found = {}
    for path in [Path(path) for path in paths] or sorted(CHECKPOINTS.glob("*.json")):
        for precision, text in sanitized(path):
            found[f"{path.stem}, {precision}"] = text
            print(f"{path.stem}, {precision}: {text or 'clean'}", flush=True)
    RESULT.parent.mkdir(exist_ok=True)
    RESULT.write_text(json.dumps(found, indent=1) + "\n")
    return int(any(found.values()))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
