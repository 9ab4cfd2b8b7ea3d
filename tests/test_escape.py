"""Foreign text stays text in C, HTML and Markdown."""

from __future__ import annotations

import re

from hypothesis import given
from hypothesis import strategies as st

from difffilter.errors import DifffilterError, InputError
from difffilter.escape import c_comment, html, markdown, prose, tagless

TEXT = st.text(st.sampled_from("*/\\?<>[]|`#!ab \n\r\x1b\u202e\ud800$&\"'") | st.characters())


@given(TEXT)
def test_a_comment_is_one_line_that_ends_nothing_and_joins_nothing(text: str) -> None:
    shown = c_comment(text)
    assert not set("*\\\n") & set(shown)
    assert "??" not in shown
    assert shown.isprintable()


@given(TEXT)
def test_no_tag_begins_in_a_page(text: str) -> None:
    for shown in (html(text), tagless(text)):
        assert not set("<>\x1b\u202e") & set(shown)
    assert '"' not in html(text)


@given(TEXT)
def test_a_cell_of_markdown_is_text(text: str) -> None:
    shown = markdown(text)
    assert "\n" not in shown
    plain = re.sub(r"\\[\\`*|<>\[\]]", "", shown)
    assert not set("`*|<>[]") & set(plain)


@given(TEXT)
def test_a_paragraph_begins_no_heading_and_holds_no_tag_or_link(text: str) -> None:
    shown = prose(text)
    assert "\n" not in shown
    assert not re.match(r"[#+=~>-]", shown)
    plain = re.sub(r"\\[\\<>\[\]]", "", re.sub(r"(?<!`)`[^`]+`(?!`)", "", shown))
    assert not set("<>[]") & set(plain)


def test_words_are_as_before() -> None:
    plain = "range.sigma: 0.2 m/s^2, größe"
    assert c_comment(plain) == html(plain) == markdown(plain) == prose(plain) == plain
    assert prose("**strong** and `code`") == "**strong** and `code`"
    assert c_comment("a */ b ??/ c") == "a x/ b ? ?/ c"


@given(TEXT)
def test_an_error_is_one_line_of_bounded_length(text: str) -> None:
    said = str(InputError(f"log: found {text * 100}, expected a number"))
    assert said.isprintable()
    assert len(said) < 10_100  # each character as its number at most


def test_what_was_found_is_not_echoed_whole() -> None:
    said = str(DifffilterError(f"log.csv, line 3: found {'x' * 10**7}, expected a number"))
    assert len(said) < 1010
    assert said.startswith("log.csv, line 3: found xxx")
    assert said.endswith("xxx, expected a number")
