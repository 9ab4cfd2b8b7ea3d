"""Pages in a real browser: whole and silent, on a phone, on a desk and on paper."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import SCREENS, chromium, faults_on_paper, faults_on_screen, launched, opened
from cli_helpers import succeeds
from matplotlib.figure import Figure

from difffilter.reports import page
from difffilter.reports.report import Report

ROOT = Path(__file__).parents[2]
CHECKPOINTS = ("airport-mlat-intermittent.json", "airborne-bearing.json")
LONG = "credibility.followed_by_a_word_without_any_gap_" * 3


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    pytest.importorskip("playwright", reason="no playwright: pip install -e '.[test]'")
    program = chromium()
    if program is None:
        pytest.skip("no Chromium: apt-get install chromium, or name one in DIFFFILTER_CHROMIUM")
    with launched(program) as browser:
        yield browser


@pytest.fixture(scope="module")
def verdict(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of ``difffilter report`` on two checkpoints."""
    folder = tmp_path_factory.mktemp("verdict")
    held = [ROOT / "checkpoints" / name for name in CHECKPOINTS]
    succeeds("report", *held, "--trajectories", 2, "--out", folder)
    return folder / "report.html"


@pytest.fixture(scope="module")
def joined(browser: Any, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page that strains everything."""
    folder = tmp_path_factory.mktemp("joined")
    wide_report(folder)
    return folder / "report.html"


def wide_report(folder: Path) -> None:
    """A report that strains its page."""
    report = Report(folder, LONG)
    report.heading(f"Wide: {LONG}")
    report.text(f"A long `{LONG}` and a **{LONG}**.")
    head = ["system", "published (m)", *(f"scene {i} rejected (%)" for i in range(10))]
    rows = [["m-ekf-all-rows", *([1234.5678] * 11)], [LONG, *([(0.123, 4.567)] * 11)]]
    report.table("wide", head, rows, paper=f"says {LONG}")
    report.table("long", [LONG, "b"], [["a sentence of many words " * 12, LONG]])
    for name, points in (("drawn", 20), ("heavy", 20_000)):
        figure = Figure(figsize=(12, 4))
        y = np.random.default_rng(0).normal(size=points)
        figure.subplots().scatter(np.arange(points), y, s=1)
        report.figure(figure, name, f"{name} {LONG}")
    for held in (True, False, None):
        report.claim(f"a claim that is {held} {LONG}", held, {LONG: (0.5, 0.7)})
    report.write()


@pytest.fixture(params=["verdict", "joined"])
def made(request: pytest.FixtureRequest) -> Path:
    return request.getfixturevalue(request.param)


@pytest.mark.parametrize("screen", SCREENS)
def test_a_page_opens_whole_and_silent_and_fits_the_screen(
    browser: Any, made: Path, screen: str
) -> None:
    assert faults_on_screen(browser, made, screen) == []


def test_a_page_prints_whole(browser: Any, made: Path) -> None:
    assert faults_on_paper(browser, made) == []


def test_the_joined_page_has_all_that_could_go_wrong(joined: Path) -> None:
    text = joined.read_text(encoding="utf-8")
    for part in ("image/svg+xml", "image/png", 'class="held"', 'class="missed"', 'class="open"'):
        assert text.count(part) == 1


def test_a_wide_table_scrolls_by_itself_on_a_phone(browser: Any, joined: Path) -> None:
    with opened(browser, joined, SCREENS["phone"]) as (shown, _):
        box = shown.locator(".wide:has(table)").first
        assert box.evaluate("box => box.scrollWidth > box.clientWidth")
        assert box.evaluate("box => { box.scrollLeft = 50; return box.scrollLeft; }") == 50


BROKEN = {
    "an image has not loaded": '<img alt="x" src="data:image/png;base64,AAAA">',
    "an image has no text": '<img src="data:image/gif;base64,R0lGODlhAQABAAAAACwAAAAAAQABAAAC">',
    "console error: oh": "<script>console.error('oh')</script>",
    "console warning: hm": "<script>console.warn('hm')</script>",
    "page error: oops": "<script>throw new Error('oops')</script>",
    "asks for https://example.org/x.png": '<img alt="x" src="https://example.org/x.png">',
    "request failed: file:///none.css": '<link rel="stylesheet" href="file:///none.css">',
    "sticks out: div": '<div style="width: 1400px">wide</div>',
    "text sticks out: p": f'<p style="white-space: nowrap">{"word " * 400}</p>',
    "a link leads nowhere: #gone": '<a href="#gone">gone</a>',
    "two elements are called 'x'": '<p id="x">a</p><p id="x">b</p>',
}


@pytest.mark.parametrize("screen", SCREENS)
@pytest.mark.parametrize("fault", BROKEN)
def test_a_fault_is_told(browser: Any, tmp_path: Path, screen: str, fault: str) -> None:
    path = tmp_path / "page.html"
    path.write_text(page.page("broken", [BROKEN[fault]]))
    found = faults_on_screen(browser, path, screen)
    assert any(line.startswith(fault) for line in found), found


@pytest.mark.parametrize(
    ("fault", "body"),
    [
        (
            "hidden on paper: p",
            '<style>@media print { p { display: none } }</style><p id="x">a</p>',
        ),
        ("cut off on paper: div", '<div style="overflow: auto">a</div>'),
        ("the page is 800 px wide", '<div style="width: 800px">a</div>'),
    ],
)
def test_a_fault_on_paper_is_told(browser: Any, tmp_path: Path, fault: str, body: str) -> None:
    path = tmp_path / "page.html"
    path.write_text(page.page("broken", [body]))
    found = faults_on_paper(browser, path)
    assert any(line.startswith(fault) for line in found), found
