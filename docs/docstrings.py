"""Docstrings for the site: roles become links, ``::`` a colon, ``#:`` comments docstrings."""

from __future__ import annotations

import ast
import re
from typing import Any

from griffe import Attribute, Docstring, Extension, Object, ObjectNode

ROLE = re.compile(r":(?:func|class|meth|mod|data):`([^`]+)`")
BLOCK = re.compile(r"::$", re.MULTILINE)
COMMENT = re.compile(r"\s*#: ?(.*)")


class Docstrings(Extension):
    """Reads the library's docstrings as Markdown."""

    def on_object(self, *, obj: Object, **kwargs: Any) -> None:
        """Replace what only Sphinx reads."""
        if obj.docstring is not None:
            module = obj.module.path

            def link(found: re.Match[str]) -> str:
                name = found[1]
                path = name if name.startswith("difffilter.") else f"{module}.{name}"
                return f'<autoref identifier="{path}" optional><code>{name}</code></autoref>'

            obj.docstring.value = BLOCK.sub(":", ROLE.sub(link, obj.docstring.value))

    def on_attribute_instance(
        self, *, node: ast.AST | ObjectNode, attr: Attribute, **kwargs: Any
    ) -> None:
        """The comment of ``#:`` lines above an assignment."""
        if attr.docstring is None and attr.lineno and isinstance(node, ast.AST):
            found: list[str] = []
            for line in reversed(attr.lines_collection[attr.filepath][: attr.lineno - 1]):
                comment = COMMENT.fullmatch(line)
                if comment is None:
                    break
                found.insert(0, comment[1])
            if found:
                attr.docstring = Docstring("\n".join(found), parent=attr)
