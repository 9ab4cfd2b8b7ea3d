"""What each report says last of its paper: its items and where they stand, and what stays open."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from difffilter.reports.report import Report

__all__ = ["contents"]


def contents(
    report: Report, items: Sequence[tuple[str, str, str]], unchecked: Mapping[str, str]
) -> None:
    """A table of the paper's figures and tables, and claims that no run can check.

    Args:
        items: of the paper: name, what it is, where here.
        unchecked: claim to the reason why it cannot be checked.
    """
    report.heading("The paper's figures and tables")
    report.text("Of the claims below, those that name no paper are this project's own targets.")
    report.table("the paper's items", ["the paper", "what it is", "here"], items)
    for text, why in unchecked.items():
        report.claim(text, None, {"why": why})
