"""The HTML page of a report: whole, alone, and safe from what stands in it."""

from __future__ import annotations

import re
from html.parser import HTMLParser
from pathlib import Path

from matplotlib.figure import Figure

from difffilter.reports.page import paragraph
from difffilter.reports.report import Report


class Balanced(HTMLParser):
    """Fails on a tag that is not closed."""

    void = frozenset({"meta", "link", "img"})

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.seen: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.seen.append(tag)
        if tag not in self.void:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def written(folder: Path) -> str:
    report = Report(folder, "a < b & c", {"seed": 1})
    report.heading("errors & more")
    report.text("a **strong** word, `code`, <script>")
    report.table("errors", ["system", "RMSE (m)"], [["<ekf>", 1.25], ["robust", None]])
    figure = Figure()
    figure.subplots().plot([0.0, 1.0])
    report.figure(figure, "line", "A <line>")
    report.claim("robust is better", True, {"ratio": (0.5, 0.7)})
    report.claim("ekf is better", False, {})
    report.write()
    return (folder / "report.html").read_text(encoding="utf-8")


def test_every_tag_is_closed_and_every_text_escaped(tmp_path: Path) -> None:
    text = written(tmp_path)
    parser = Balanced()
    parser.feed(text)
    assert parser.open == []
    assert {"table", "figure", "img", "h2", "style"} <= set(parser.seen)
    assert "<script>" not in text
    for shown in ("a &lt; b &amp; c", "&lt;ekf&gt;", "A &lt;line&gt;", "errors &amp; more"):
        assert shown in text


def test_the_page_needs_nothing_from_elsewhere(tmp_path: Path) -> None:
    text = written(tmp_path)
    for value in re.findall(r'(?:src|href)="([^"]*)"', text):
        assert value.startswith("data:")
    assert "url(" not in text
    assert "@import" not in text


def test_claims_say_whether_they_held(tmp_path: Path) -> None:
    text = written(tmp_path)
    assert text.index("robust is better") < text.index('class="held">held')
    assert text.index("ekf is better") < text.index('class="missed">not held')
    assert "0.500 to 0.700" in text


def test_marks_of_a_paragraph_are_kept() -> None:
    assert paragraph("**x** is `y` < z") == "<p><strong>x</strong> is <code>y</code> &lt; z</p>"


def test_the_same_report_gives_the_same_bytes(tmp_path: Path) -> None:
    assert written(tmp_path / "a") == written(tmp_path / "b")
