"""Opens a page in a headless Chromium and says what is wrong with it.

The browser is the machine's own: ``DIFFFILTER_CHROMIUM``, or else one found on the path.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

NAMES = ("chromium", "chromium-browser", "google-chrome")
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
#: Settings of a screen: name, then what the browser is told.
SCREENS: dict[str, dict[str, Any]] = {
    "phone": {
        "viewport": {"width": 390, "height": 844},
        "device_scale_factor": 3,
        "is_mobile": True,
        "has_touch": True,
    },
    "desk": {"viewport": {"width": 1280, "height": 900}},
}
#: CSS pixels of an A4 page between margins of 1.5 cm.
PAPER = int((210 - 30) / 25.4 * 96)

#: What the page itself tells: how far it scrolls, and what is wrong with its elements.
LOOK = """\
(width) => {
  const faults = [];
  const name = (element) =>
    element.tagName.toLowerCase() + " '" + (element.textContent || "").trim().slice(0, 40) + "'";
  const root = document.documentElement;
  if (root.scrollWidth > width)
    faults.push(`the page is ${root.scrollWidth} px wide, the screen ${width}`);
  const contained = (element) => {
    for (let up = element; up !== document.body; up = up.parentElement)
      if (getComputedStyle(up).overflowX !== "visible") return true;
    return false;
  };
  const outside = (box) => box.width > 0 && (box.left < -0.5 || box.right > width + 0.5);
  for (const element of document.body.querySelectorAll("*"))
    if (outside(element.getBoundingClientRect()) && !contained(element.parentElement))
      faults.push(`sticks out: ${name(element)}`);
  const texts = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
  for (let text = texts.nextNode(); text; text = texts.nextNode()) {
    const range = document.createRange();
    range.selectNodeContents(text);
    if (![...range.getClientRects()].some(outside) || contained(text.parentElement)) continue;
    faults.push(`text sticks out: ${name(text.parentElement)}`);
  }
  for (const image of document.images) {
    if (!image.complete || image.naturalWidth === 0)
      faults.push(`an image has not loaded: '${image.alt}'`);
    if (!image.alt.trim()) faults.push("an image has no text in its place");
  }
  const ids = [...document.querySelectorAll("[id]")].map((element) => element.id);
  for (const id of ids.filter((id, place) => ids.indexOf(id) !== place))
    faults.push(`two elements are called '${id}'`);
  for (const link of document.querySelectorAll("a[href^='#']"))
    if (!document.getElementById(decodeURIComponent(link.hash.slice(1))))
      faults.push(`a link leads nowhere: ${link.hash}`);
  return faults;
}"""

#: What paper would lack: hidden elements, and what only scrolling would show.
LACKS = """\
() => [...document.body.querySelectorAll("*")].flatMap((element) => {
  const style = getComputedStyle(element);
  const name = element.tagName.toLowerCase();
  const faults = [];
  if (style.display === "none" || style.visibility !== "visible" || style.opacity === "0")
    faults.push(`hidden on paper: ${name}`);
  if (name !== "img" && (style.overflowX !== "visible" || style.overflowY !== "visible"))
    faults.push(`cut off on paper: ${name}`);
  return faults;
})"""


def chromium() -> str | None:
    """The program; None where there is none."""
    named = os.environ.get("DIFFFILTER_CHROMIUM")
    return shutil.which(named) if named else next(filter(None, map(shutil.which, NAMES)), None)


@contextmanager
def launched(program: str) -> Iterator[Browser]:
    """A headless browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=program, args=list(FLAGS))
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def opened(
    browser: Browser, path: Path, screen: dict[str, Any]
) -> Iterator[tuple[Page, list[str]]]:
    """The page, loaded, and the faults met so far: messages, errors and requests.

    Nothing but the file itself is let through.
    """
    address = path.resolve().as_uri()
    faults: list[str] = []
    with browser.new_context(**screen) as context:
        page = context.new_page()

        def fetch(route: Any) -> None:
            if route.request.url == address:
                route.continue_()
            else:
                faults.append(f"asks for {route.request.url}")
                route.abort()

        def said(message: Any) -> None:
            if message.type in ("error", "warning", "assert"):
                faults.append(f"console {message.type}: {message.text}")

        page.route(re.compile("^(?!data:)"), fetch)
        page.on("console", said)
        page.on("pageerror", lambda error: faults.append(f"page error: {error}"))
        page.on("requestfailed", lambda request: faults.append(f"request failed: {request.url}"))
        page.goto(address, wait_until="networkidle")
        yield page, faults


def faults_on_screen(browser: Browser, path: Path, screen: str) -> list[str]:
    """What is wrong with a page on one of :data:`SCREENS`; empty if nothing is."""
    settings = SCREENS[screen]
    with opened(browser, path, settings) as (page, faults):
        return [*page.evaluate(LOOK, settings["viewport"]["width"]), *faults]


def faults_on_paper(browser: Browser, path: Path) -> list[str]:
    """What is wrong with a page printed on A4; empty if nothing is."""
    screen = {"viewport": {"width": PAPER, "height": 1000}}
    with opened(browser, path, screen) as (page, faults):
        page.emulate_media(media="print")
        found = [*page.evaluate(LOOK, PAPER), *page.evaluate(LACKS)]
        if not pages_of(page.pdf(format="A4")):
            found.append("the PDF has no page")
        return [*found, *faults]


def pages_of(pdf: bytes) -> int:
    """How many pages a PDF says it has."""
    return len(re.findall(rb"/Type\s*/Page\b", pdf)) if pdf.startswith(b"%PDF") else 0
