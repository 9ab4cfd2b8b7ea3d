"""One HTML page that stands alone: text, tables and figures, for screen, phone and paper."""

from __future__ import annotations

import base64
import re
from collections.abc import Sequence
from pathlib import Path

from difffilter.escape import html, tagless

__all__ = ["END", "START", "aside", "card", "figure", "index", "page", "paragraph", "table"]

#: Between these stands the body, for pages made of several.
START, END = "<!-- body -->", "<!-- end of body -->"
#: Bytes of an SVG from which its PNG is shown: thousands of points draw slowly.
HEAVY = 300_000

#: A word of a table with this many letters may be broken.
LONG = 24
#: Words that stand out in a table, and their class.
MARKS = {
    "held": "held", "not held": "missed", "cannot be checked": "open",
    "adopt": "adopt", "adopt if": "if", "keep": "keep",
}  # fmt: skip

_STYLE = """\
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, sans-serif; color: #1a1a1a; max-width: 60rem;
       margin: 0 auto; padding: 1rem; overflow-wrap: break-word; }
h1 { font-size: 1.7rem; } h2 { font-size: 1.25rem; margin-top: 2.2rem; }
.wide { overflow-x: auto; margin: 1rem 0; }
table { border-collapse: collapse; font-size: 0.85rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.25rem 0.6rem; border-bottom: 1px solid #ddd; text-align: left;
         vertical-align: top; }
th { border-bottom: 2px solid #888; }
.long { overflow-wrap: anywhere; }
figure { margin: 1.2rem 0; } figure .wide { margin: 0; }
img { max-width: max(100%, 40rem); height: auto; vertical-align: bottom; }
figcaption { font-size: 0.85rem; color: #444; }
.held { color: #00694c; font-weight: 600; } .missed { color: #a33c00; font-weight: 600; }
.open { color: #555; font-style: italic; }
aside { border-left: 3px solid #4477aa; margin: 0.8rem 0 1.6rem; padding: 0.1rem 0.9rem;
        color: #333; font-size: 0.92rem; background: #f5f7fa; }
.grade { display: inline-block; padding: 0.15rem 0.8rem; border-radius: 0.3rem; color: white;
         font-weight: 700; font-size: 1.2rem; }
.adopt { color: #00694c; font-weight: 600; } .if { color: #8a5a00; font-weight: 600; }
.keep { color: #a33c00; font-weight: 600; }
.grade.adopt { background: #00694c; color: white; } .grade.if { background: #8a5a00; color: white; }
.grade.keep { background: #a33c00; color: white; }
dl { margin: 0.8rem 0; display: grid; grid-template-columns: 11rem 1fr; gap: 0.4rem 1rem; }
dt { font-weight: 600; } dd { margin: 0; }
@media screen and (max-width: 40rem) { dl { grid-template-columns: 1fr; gap: 0.1rem; }
                                       dd { margin-bottom: 0.5rem; } }
summary { cursor: pointer; font-weight: 600; padding: 0.45rem 0; border-top: 1px solid #ddd; }
nav a { display: inline-block; margin-right: 1rem; padding: 0.4rem 0; }
@media screen and (max-width: 40rem) { table { width: max-content; }
                                       th, td { max-width: 14rem; } }
@page { margin: 1.5cm; }
@media print { body { max-width: none; padding: 0; } .wide { overflow: visible; }
               table { font-size: 10px; } th, td { padding: 2px 4px; }
               img { max-width: 100%; } h1, h2 { break-after: avoid; }
               figure, tr { break-inside: avoid; } }
"""


def page(title: str, body: Sequence[str]) -> str:
    """The whole page."""
    inside = "\n".join(body)
    return f"""\
<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{html(title)}</title>
<style>
{_STYLE}</style>
</head>
<body>
<h1>{html(title)}</h1>
{START}
{inside}
{END}
</body>
</html>
"""


def card(word: str, rows: Sequence[tuple[str, str]]) -> str:
    """A grade in its colour, and what is to be known at once."""
    lines = "\n".join(f"<dt>{_words(name)}</dt><dd>{_words(text)}</dd>" for name, text in rows)
    kind = MARKS.get(word, "open")
    return f'<p><span class="grade {kind}">{html(word)}</span></p>\n<dl>\n{lines}\n</dl>'


def index(head: Sequence[str], rows: Sequence[Sequence[str]], links: Sequence[str]) -> str:
    """A table whose first cells lead to pages of their own."""
    cells = "".join(f"<th>{_words(text)}</th>" for text in head)
    lines = "\n".join(
        f'<tr><td><a href="{html(link)}">{_words(row[0])}</a></td>'
        + "".join(f"<td>{_cell(text)}</td>" for text in row[1:])
        + "</tr>"
        for row, link in zip(rows, links, strict=True)
    )
    return (
        f'<div class="wide"><table>\n<thead><tr>{cells}</tr></thead>\n'
        f"<tbody>\n{lines}\n</tbody>\n</table></div>"
    )


def aside(text: str) -> str:
    """A paragraph beside the main text; as :func:`paragraph`."""
    return f"<aside>{paragraph(text)}</aside>"


def paragraph(text: str) -> str:
    """A paragraph; ``**strong**`` and `` `code` `` of the text are kept."""
    shown = tagless(text)
    shown = re.sub(r"\*\*(.+?)\*\*", r"<strong>\1</strong>", shown)
    shown = re.sub(r"`(.+?)`", r"<code>\1</code>", shown)
    return f"<p>{shown}</p>"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table that scrolls by itself where the page is narrow."""
    cells = "".join(f"<th>{_words(text)}</th>" for text in head)
    lines = "\n".join(
        "<tr>" + "".join(f"<td>{_cell(text)}</td>" for text in row) + "</tr>" for row in rows
    )
    return (
        f'<div class="wide"><table>\n<thead><tr>{cells}</tr></thead>\n'
        f"<tbody>\n{lines}\n</tbody>\n</table></div>"
    )


def figure(path: Path, caption: str) -> str:
    """A figure written at ``path`` (without suffix), inline."""
    svg = path.with_suffix(".svg").read_bytes()
    kind, data = "svg+xml", svg
    if len(svg) > HEAVY:
        kind, data = "png", path.with_suffix(".png").read_bytes()
    source = f"data:image/{kind};base64,{base64.b64encode(data).decode()}"
    shown = html(caption)
    image = f'<div class="wide"><img alt="{shown}" src="{source}"></div>'
    return f"<figure>{image}<figcaption>{shown}</figcaption></figure>"


def _cell(text: str) -> str:
    shown = _words(text)
    return f'<span class="{MARKS[text]}">{shown}</span>' if text in MARKS else shown


def _words(text: str) -> str:
    parts = re.split(rf"(\S{{{LONG},}})", text)
    shown = [tagless(part) for part in parts]
    shown[1::2] = [f'<span class="long">{word}</span>' for word in shown[1::2]]
    return "".join(shown)
