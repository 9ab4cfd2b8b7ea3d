"""What surrounds a command: imports, encodings, closed streams, interruption, long values."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from cli_helpers import TINY, environment, process

from difffilter.errors import printable

QUICK = ["--help", "--version", "scenarios", "tune --help"]


@pytest.mark.parametrize("command", QUICK)
def test_what_needs_no_torch_does_not_import_it(command: str) -> None:
    code = (
        "import sys; from difffilter.cli.main import main; "
        f"main({command.split()!r}); sys.exit('torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment())
    assert done.returncode == 0, done.stderr


def test_importing_the_package_imports_no_torch() -> None:
    code = "import sys, difffilter; sys.exit('torch' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], env=environment()).returncode == 0


def test_characters_outside_the_encoding_are_escaped(tmp_path: Path) -> None:
    (tmp_path / "tiny.toml").write_text(TINY.replace("Twenty steps", "Łódź 東京"), encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "difffilter", "show", "tiny.toml"],
        capture_output=True,
        cwd=tmp_path,
        env=environment() | {"PYTHONIOENCODING": "cp1252"},
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == b""
    assert b"\\u0141\xf3d\\u017a \\u6771\\u4eac" in done.stdout


def test_closed_standard_output() -> None:
    command = f"{sys.executable} -m difffilter scenarios >&-"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, env=environment())
    assert done.returncode == 2
    assert done.stderr == "difffilter: error: standard output is closed, expected it open\n"


def test_closed_standard_error() -> None:
    command = f"{sys.executable} -m difffilter show nothing 2>&-"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, env=environment())
    assert (done.returncode, done.stdout, done.stderr) == (2, "", "")


def test_interruption_during_the_imports(tmp_path: Path) -> None:
    """A module that is imported by the command is struck by Ctrl-C, as torch might be."""
    (tmp_path / "torch.py").write_text("raise KeyboardInterrupt\n")
    path = os.pathsep.join([str(tmp_path), *sys.path])
    done = subprocess.run(
        [sys.executable, "-m", "difffilter", "show", "airport-mlat"],
        capture_output=True,
        text=True,
        env=environment() | {"PYTHONPATH": path},
    )
    assert (done.returncode, done.stdout) == (130, "")
    assert done.stderr == "difffilter: interrupted\n"


def test_long_and_strange_values_are_cut_and_escaped(tmp_path: Path) -> None:
    (tmp_path / "tiny.toml").write_text(TINY.replace("steps = 20", f'steps = "{"x" * 10**6}"'))
    done = process("show", "tiny.toml", cwd=tmp_path)
    assert done.returncode == 2
    assert "world.steps: found 'xxx" in done.stderr
    assert len(done.stderr) < 400
    done = process("show", "a\x1b[31m\n\u200b.toml")
    assert done.stderr.startswith(r"difffilter: error: a\x1b[31m\n\u200b.toml: found")


def test_printable() -> None:
    assert printable("a\tb") == r"a\tb"
    assert printable("a" * 3000) == f"{'a' * 666} ... {'a' * 334}"
