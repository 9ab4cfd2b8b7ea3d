"""The floors of pyproject.toml hold: import-linter, imports within functions and for types too."""

from __future__ import annotations

import ast
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
LINTER = Path(sys.executable).with_name("lint-imports")


def test_rooms_import_from_lower_floors_alone() -> None:
    done = subprocess.run(
        [str(LINTER), "--no-cache"],
        cwd=ROOT,
        capture_output=True,
        text=True,
        encoding="utf-8",
        check=False,
    )
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr
    assert "2 kept, 0 broken" in done.stdout


def test_no_room_imports_the_front_door() -> None:
    """``difffilter/__init__`` knows every room, so no room knows it."""
    for path in (ROOT / "difffilter").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                assert "difffilter" not in {alias.name for alias in node.names}, path
            elif isinstance(node, ast.ImportFrom) and node.module == "difffilter":
                rooms = {alias.name for alias in node.names}
                assert all((ROOT / "difffilter" / name).is_dir() for name in rooms), path


def test_the_page_of_the_floors_is_that_of_the_contract() -> None:
    document = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    layers = document["tool"]["importlinter"]["contracts"][0]["layers"]
    floors = [set(layer.split(" | ")) for layer in reversed(layers) if layer != "__main__"]
    page = (ROOT / "docs" / "design.md").read_text(encoding="utf-8")
    table = page.partition("| floor | holds |\n|---|---|\n")[2].partition("\n\n")[0]
    told = [line.split("|")[1] for line in table.splitlines()]
    names = [
        {name.strip(" `").removesuffix("/").removesuffix(".py") for name in cell.split(",")}
        for cell in told
    ]
    assert names == floors
