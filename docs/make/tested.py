"""Writes the figures of docs/tested.md: tests by kind, and what campaign and sanitizers last found.

python -m docs.make.tested     # after make fuzz and make sanitize
"""

from __future__ import annotations

import ast
import json
from pathlib import Path

from difffilter.files import write_atomically

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "tested.md"
CAMPAIGN = ROOT / "report" / "fuzz" / "counts.json"
SANITIZED = ROOT / "report" / "sanitize.json"
BEGIN, END = "<!-- figures: written by docs/make/tested.py -->", "<!-- end of figures -->"


def counted() -> list[tuple[str, int]]:
    """Tests by kind, as the source has them; a parametrised test counts once."""
    tests = properties = gradients = processes = 0
    for path in (ROOT / "tests").rglob("test_*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                tests += 1
                marks = [ast.unparse(mark) for mark in node.decorator_list]
                properties += any(mark.startswith("given(") for mark in marks)
                body = ast.unparse(node)
                gradients += "gradcheck(" in body
                processes += any(f"{name}(" in body for name in ("process", "succeeds", "Popen"))
    oracles = sum(
        isinstance(node, ast.FunctionDef) and not node.name.startswith("_")
        for path in (ROOT / "tests" / "oracles").glob("*.py")
        for node in ast.parse(path.read_text(encoding="utf-8")).body
    )
    return [
        ("test functions", tests),
        ("of them property tests", properties),
        ("of them with a gradient check", gradients),
        ("of them with the command line as a process", processes),
        ("oracles: functions in NumPy", oracles),
    ]


def text() -> str:
    """The tables."""
    lines = ["| tests | |", "|---|---|", *(f"| {name} | {count:,} |" for name, count in counted())]
    if CAMPAIGN.is_file():
        counts = json.loads(CAMPAIGN.read_text(encoding="utf-8"))
        lines += ["", "| last campaign | |", "|---|---|"]
        lines += [f"| {name} | {count:,} |" for name, count in counts.items()]
    if SANITIZED.is_file():
        found = json.loads(SANITIZED.read_text(encoding="utf-8"))
        clean = sum(not text for text in found.values())
        lines += ["", f"Sanitizers: {clean} of {len(found)} self-tests of exported C clean."]
    return "\n".join(lines) + "\n"


def main() -> None:
    """Put the figures in their place."""
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(BEGIN)
    _, _, after = rest.partition(END)
    write_atomically(PAGE, f"{before}{BEGIN}\n\n{text()}\n{END}{after}")


if __name__ == "__main__":
    main()
