"""The documentation as a site: it builds without a warning, and stands alone."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import re
import subprocess
import sys
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from urllib.parse import unquote, urlsplit

import pytest

import difffilter

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(path.relative_to(DOCS).with_suffix(".html") for path in DOCS.rglob("*.md"))
#: Elements that load what they name; of links, those that are styles, icons and the like.
LOADING = {"script", "img", "iframe", "link", "source", "video", "audio", "embed", "object"}
#: Links that name a page without loading it.
NAMING = {"canonical", "prev", "next", "edit"}
IMPORT = re.compile(r"^from (difffilter[.\w]*) import (\w+(?:, \w+)*)$", re.MULTILINE)
WIDTHS = "width=device-width"

pytestmark = [
    pytest.mark.skipif(
        not all(importlib.util.find_spec(name) for name in ("mkdocs", "material", "mkdocstrings")),
        reason="mkdocs-material or mkdocstrings is not installed: pip install -e '.[docs]'",
    ),
    pytest.mark.xdist_group("site"),
]


class Page(HTMLParser):
    """Anchors, links and what a page loads."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loads: list[str] = []
        self.viewport = ""
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        found = {name: value or "" for name, value in attrs}
        self.anchors |= {found[name] for name in ("id", "name") if name in found}
        if tag == "meta" and found.get("name") == "viewport":
            self.viewport = found["content"]
        elif tag == "a" and "href" in found:
            self.links.append(found["href"])
        elif tag in LOADING and not NAMING & set(found.get("rel", "").split()):
            self.loads += [found[name] for name in ("src", "href", "data") if name in found]


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built in a process of its own as ``make docs`` does."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(
        command,
        cwd=ROOT,
        env=os.environ | {"NO_MKDOCS_2_WARNING": "true"},
        capture_output=True,
        text=True,
    )
    said = done.stdout + done.stderr
    assert done.returncode == 0, said
    assert not re.search(r"warning|error", said, re.IGNORECASE), said
    return folder


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[Path, Page]:
    """Every page of the site."""
    return {path: Page(path) for path in site.rglob("*.html")}


def each(pages: dict[Path, Page], of: Callable[[Page], list[str]]) -> list[tuple[Path, str]]:
    """Pairs of a page and an address; the page of errors has addresses from the root."""
    return [(path, url) for path, page in pages.items() if path.name != "404.html"
            for url in of(page)]  # fmt: skip


def test_every_page_is_built(site: Path) -> None:
    for page in PAGES:
        assert (site / page).is_file(), page
    assert (site / "example.toml").is_file()
    assert not list(site.rglob("*.py"))


def test_every_link_and_anchor_resolves(pages: dict[Path, Page]) -> None:
    links = [(path, url) for path, url in each(pages, lambda page: page.links)
             if not urlsplit(url).scheme]  # fmt: skip
    assert len(links) > 1000
    for path, url in links:
        parts = urlsplit(url)
        target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
        target = target / "index.html" if target.is_dir() else target
        assert target.is_file(), f"{path.name}: {url}"
        if parts.fragment and target in pages:
            assert unquote(parts.fragment) in pages[target].anchors, f"{path.name}: {url}"


def test_nothing_is_loaded_from_the_network(site: Path, pages: dict[Path, Page]) -> None:
    for path, url in each(pages, lambda page: page.loads):
        if not url.startswith("data:"):
            assert not urlsplit(url).netloc, f"{path.name}: {url}"
            assert (path.parent / unquote(urlsplit(url).path)).is_file(), f"{path.name}: {url}"
    for style in site.rglob("*.css"):
        text = style.read_text(encoding="utf-8")
        assert not re.search(r"url\(['\"]?(https?:)?//|@import", text), style.name


def test_every_page_fits_a_phone(pages: dict[Path, Page]) -> None:
    for path, page in pages.items():
        assert WIDTHS in page.viewport, path.name


@pytest.fixture(scope="module")
def documented(pages: dict[Path, Page]) -> set[int]:
    """Identities of what has an entry in the reference."""
    found = set()
    for path, page in pages.items():
        for anchor in page.anchors if path.parent.name == "reference" else ():
            module, _, name = anchor.rpartition(".")
            if module.split(".")[0] == "difffilter":
                with contextlib.suppress(ModuleNotFoundError):  # a member of a class
                    found.add(id(getattr(importlib.import_module(module), name)))
    return found


def test_every_public_name_is_in_the_reference(documented: set[int]) -> None:
    for name in difffilter.__all__:
        assert id(getattr(difffilter, name)) in documented, name


def test_every_name_that_a_page_tells_of_is_in_the_reference(documented: set[int]) -> None:
    """Those of the public modules: ``from difffilter.scoring.losses import Loss``."""
    for page in DOCS.rglob("*.md"):
        text = page.read_text(encoding="utf-8")
        for module, names in IMPORT.findall(text):
            for name in names.split(", "):
                thing = getattr(importlib.import_module(module), name)
                assert id(thing) in documented, f"{page.name}: {module}.{name}"
        for module, name in re.findall(r"`(difffilter[.\w]*)\.(\w+)`", text):
            with contextlib.suppress(ModuleNotFoundError):  # a module need not be loaded yet
                importlib.import_module(f"{module}.{name}")
            thing = getattr(importlib.import_module(module), name)
            assert isinstance(thing, ModuleType) or id(thing) in documented, f"{page.name}: {name}"
