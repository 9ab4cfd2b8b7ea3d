"""Writes the map of rooms and modules into docs/design.md, from their docstrings.

python -m docs.make.rooms
"""

from __future__ import annotations

import ast
from pathlib import Path

from difffilter.files import write_atomically

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "design.md"
BEGIN, END = "<!-- map: written by docs/make/rooms.py -->", "<!-- end of map -->"


def text() -> str:
    """Every room and module, one line each."""
    lines: list[str] = []
    package = ROOT / "difffilter"
    rooms = sorted({path.parent for path in package.rglob("*.py")})
    for room in rooms:
        name = room.relative_to(package).as_posix()
        shown = "difffilter" if name == "." else f"{name}/"
        lines += ["", f"**`{shown}`**: {_first(room / '__init__.py')}", ""]
        for path in sorted(room.glob("*.py")):
            if not path.stem.startswith("__"):
                lines.append(f"- `{path.relative_to(package).as_posix()}`: {_first(path)}")
    return "\n".join(lines) + "\n"


def _first(path: Path) -> str:
    """The first sentence of a module's docstring."""
    found = ast.get_docstring(ast.parse(path.read_text(encoding="utf-8"))) or ""
    return " ".join(found.split("\n\n")[0].split())


def main() -> None:
    """Put the map in its place."""
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    write_atomically(PAGE, f"{before}{BEGIN}\n{text()}\n{END}{after}")


if __name__ == "__main__":
    main()
