"""Reports: tables, figures and claims, written by the run that made them.

As Markdown, as JSON, and as one HTML page that stands alone.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from difffilter.comparison.comparison import Comparison
from difffilter.errors import digits
from difffilter.escape import html, markdown, markdown_table, prose
from difffilter.files import json_text, write_atomically
from difffilter.provenance import git_commit, library_versions
from difffilter.reports import page
from difffilter.reports.figures.style import save_figure

__all__ = ["HELD", "Report"]

#: What is said of a claim.
HELD: Mapping[bool | None, str] = {True: "held", False: "not held", None: "cannot be checked"}


class Report:
    """Collects what an experiment found; :meth:`write` makes report.md, .json and .html.

    Args:
        folder: where the report and its figures go.
        title: heading.
        settings: of the run, for the JSON (seed, sizes).

    Example:
        >>> import tempfile
        >>> report = Report(tempfile.mkdtemp(), "Two filters")
        >>> report.table("errors", ["system", "RMSE (m)"], [["ekf", 1.25], ["robust", 0.81]])
        >>> report.claim("robust is better", 0.81 < 1.25, {"ekf": 1.25, "robust": 0.81})
        >>> report.write().name
        'report.md'
    """

    def __init__(
        self, folder: str | Path, title: str, settings: Mapping[str, Any] | None = None
    ) -> None:
        self.folder = Path(folder)
        self.title = title
        self._lines = [f"# {markdown(title)}", ""]
        self._body: list[str] = []
        self._data: dict[str, Any] = {
            "title": title,
            "settings": dict(settings or {}),
            "versions": library_versions(),
            "git_commit": git_commit(),
            "tables": {},
            "papers": {},
            "verdicts": {},
            "judged": {},
            "comparisons": {},
            "claims": [],
            "figures": [],
        }

    def heading(self, text: str, level: int = 2) -> None:
        """A section, or at level 3 a part of one."""
        self._lines += [f"{'#' * level} {markdown(text)}", ""]
        self._body.append(f"<h{level}>{html(text)}</h{level}>")

    def verdict(self, name: str, text: str, data: Mapping[str, Any] | None = None) -> None:
        """What an engineer is advised to do about ``name``, for whoever joins reports.

        Args:
            data: the verdict as data.
        """
        self._data["verdicts"][name] = text
        if data is not None:
            self._data["judged"][name] = dict(data)

    @property
    def body(self) -> list[str]:
        """The page so far, for pages made of several."""
        return list(self._body)

    @property
    def verdicts(self) -> dict[str, str]:
        """The advice on each subject."""
        return dict(self._data["verdicts"])

    @property
    def judged(self) -> dict[str, dict[str, Any]]:
        """The verdicts as data."""
        return dict(self._data["judged"])

    def card(self, word: str, rows: Sequence[tuple[str, str]]) -> None:
        """What is seen first: a grade in its colour, and a line for each thing to know."""
        self._lines += [f"**{markdown(word)}**", ""]
        self._lines += [f"- {markdown(name)}: {markdown(text)}" for name, text in rows]
        self._lines.append("")
        self._body.append(page.card(word, rows))

    @contextmanager
    def folded(self, title: str) -> Iterator[None]:
        """Everything written inside folds out on the page."""
        self._lines += [f"### {markdown(title)}", ""]
        self._body.append(f"<details><summary>{html(title)}</summary>")
        try:
            yield
        finally:
            self._body.append("</details>")

    def index(self, head: Sequence[str], rows: Sequence[Sequence[str]], links: Sequence[str]) -> (
        None
    ):  # fmt: skip
        """A table whose first cells lead to pages of their own."""
        self._lines += [*markdown_table(head, rows), ""]
        self._body.append(page.index(head, rows, links))

    def text(self, text: str) -> None:
        """A paragraph."""
        self._lines += [prose(text), ""]
        self._body.append(page.paragraph(text))

    def table(
        self, name: str, head: Sequence[str], rows: Sequence[Sequence[Any]], paper: str = ""
    ) -> None:
        """A table; numbers are shown with four digits and kept whole in the JSON.

        Args:
            paper: what the paper says about the same table, shown beside it.
        """
        cells = [[_cell(value) for value in row] for row in rows]
        self._lines += [*markdown_table(head, cells), ""]
        self._body.append(page.table(head, cells))
        self._data["tables"][name] = [dict(zip(head, row, strict=True)) for row in rows]
        self._paper(name, paper)

    def comparison(self, name: str, comparison: Comparison) -> None:
        """A comparison's table; the JSON keeps every field of its rows."""
        self._lines += [comparison.markdown(), ""]
        self._body.append(page.table(*comparison.cells()))
        self._data["comparisons"][name] = comparison.as_dict()

    def figure(self, figure: Figure, name: str, caption: str, paper: str = "") -> None:
        """A figure, written at once as PNG and SVG.

        Args:
            paper: what the paper says about the same figure, shown beside it.
        """
        save_figure(figure, self.folder / name)
        shown = markdown(caption)
        self._lines += [f"![{shown}]({name}.png)", "", f"*{shown}* ([SVG]({name}.svg))", ""]
        self._body.append(page.figure(self.folder / name, caption))
        self._data["figures"].append({"name": name, "caption": caption})
        self._paper(name, paper)

    def _paper(self, name: str, says: str) -> None:
        if says:
            self._lines += [f"> **The paper:** {prose(says)}", ""]
            self._body.append(page.aside(f"**The paper:** {says}"))
            self._data["papers"][name] = says

    def claim(self, text: str, held: bool | None, numbers: Mapping[str, Any]) -> None:
        """A claim that the run checked, with the numbers that decide it.

        Args:
            held: None where the run cannot check it; the numbers then say why.
        """
        self._data["claims"].append({"claim": text, "held": held, "numbers": dict(numbers)})

    def write(self) -> Path:
        """Write the files; claims stand in a table at the end."""
        claims = self._data["claims"]
        if claims:
            self.heading("Claims checked by this run")
            rows = [
                [
                    entry["claim"],
                    HELD[entry["held"]],
                    ", ".join(f"{k}: {_cell(v)}" for k, v in entry["numbers"].items()),
                ]
                for entry in claims
            ]
            self._lines += ["| claim | verdict | numbers |", "|---|---|---|"]
            for claim, held, numbers in rows:
                shown = held if held == HELD[True] else f"**{held}**"
                self._lines.append(f"| {markdown(claim)} | {shown} | {markdown(numbers)} |")
            self._lines.append("")
            self._body.append(page.table(["claim", "verdict", "numbers"], rows))
        path = self.folder / "report.md"
        write_atomically(path, "\n".join(self._lines))
        write_atomically(self.folder / "report.html", page.page(self.title, self._body))
        write_atomically(self.folder / "report.json", json_text(self._data) + "\n")
        return path


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    if isinstance(value, float):
        return digits(value)
    if isinstance(value, (list, tuple)):
        return " to ".join(_cell(item) for item in value)
    return str(value)
