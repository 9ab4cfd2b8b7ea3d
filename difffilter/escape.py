"""Text from files is foreign: one function for each place that it is written to.

Names, titles, units and sources come from files that others made. Nothing of them may end a
comment, begin a tag, move a cursor or break a table. For a terminal there is
:func:`difffilter.errors.printable`. Every writer passes what it writes through
the function of its place.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from html import escape

from difffilter.errors import printable

__all__ = ["c_comment", "html", "markdown", "markdown_table", "prose", "tagless"]

#: What Markdown takes for more than text inside a line.
_MARKS = re.compile(r"([\\`*|<>\[\]])")


def _whole(text: str) -> str:
    """Text without control characters, however long."""
    return printable(re.sub(r"[\n\r\t]", " ", text), most=len(text))


def c_comment(text: str) -> str:
    """One line for the inside of a C comment, which it neither ends nor opens.

    No star, so that nothing ends; no backslash and no two question marks, so that no line is
    joined to the next (``??/`` is a backslash in C99).
    """
    line = _whole(" ".join(text.split())).replace("*", "x").replace("\\", "|")
    return line.replace("??", "? ?").replace("??", "? ?")


def html(text: str) -> str:
    """Text of an HTML page, or the value of an attribute in double quotes."""
    return escape(_whole(text))


def tagless(text: str) -> str:
    """Text between tags of an HTML page; quotes stay as they are."""
    return escape(_whole(text), quote=False)


def markdown(text: str) -> str:
    """Plain text inside a line or a cell of Markdown."""
    return _MARKS.sub(r"\\\1", _whole(" ".join(text.split())))


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    """Lines of a table in Markdown, every cell plain text."""
    lines = ["| " + " | ".join(map(markdown, cells)) + " |" for cells in (head, *rows)]
    return [lines[0], "|" + "---|" * len(head), *lines[1:]]


def prose(text: str) -> str:
    """A paragraph of Markdown whose ``**strong**`` and code are meant; no tag, link or image."""
    line = _whole(" ".join(text.split()))
    parts = re.split(r"((?<!`)`[^`]+`(?!`))", line)  # every other one is code
    parts[::2] = [re.sub(r"([\\<>\[\]])", r"\\\1", part) for part in parts[::2]]
    return re.sub(r"^(?=[#+=~-])", r"\\", "".join(parts))
