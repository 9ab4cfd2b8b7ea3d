"""Mutants of generated C: each statement with its sign, an operation or a term wrong, by number."""

from __future__ import annotations

import re

#: A statement of two operands, without spaces of their own.
STATEMENT = re.compile(r"^(\s+(?:const REAL )?[\w.>\[\]-]+ = )(\S+) ([-+*/]) (\S+);$")
SWITCH = """
#include <stdlib.h>
static int mutant(void)
{
    const char *number = getenv("MUTANT");
    return number ? atoi(number) : 0;
}
"""


def mutated(source: str) -> tuple[str, list[str]]:
    """The source with every mutant behind a switch, and what each number changes, from 1."""
    lines, told = [], []
    for line in source.splitlines():
        found = STATEMENT.match(line)
        if found is None:
            lines.append(line)
            continue
        head, a, sign, b = found.groups()
        text = f"{a} {sign} {b}"
        for other in wrong(a, sign, b):
            told.append(f"{line.strip()} -> {other}")
            text = f"chosen == {len(told)} ? ({other}) : ({text})"
        lines.append(f"{head}{text};")
    made = "\n".join(lines) + "\n"
    made = re.sub(r"^#include <string.h>$", rf"\g<0>{SWITCH}", made, flags=re.MULTILINE)
    step = re.compile(r"^(int \w+_step\([^)]*\)\n\{\n)", re.MULTILINE)
    assert step.search(made)
    return step.sub(r"\1    const int chosen = mutant();\n", made), told


def wrong(a: str, sign: str, b: str) -> list[str]:
    """Other values for an operation."""
    if sign == "+":
        return [f"{a} - {b}", a, b]
    if sign == "-":
        return [f"{a} + {b}", a]
    if sign == "*":
        return [a, f"-({a}) * {b}"]
    return [f"{a} * {b}", a]
