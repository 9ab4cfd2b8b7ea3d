"""Exported C under AddressSanitizer and UBSan: clean, and a wrong index is found."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from sanitize import CHECKPOINTS, available, said, sanitized

from difffilter.export.c99 import export_c
from difffilter.scenario.checkpoint import load

pytestmark = pytest.mark.skipif(not available(), reason="no compiler with sanitizers")
SMALLEST = CHECKPOINTS / "uwb-ranges.json"


def test_a_checkpoint_is_clean_in_double_and_float() -> None:
    assert dict(sanitized(SMALLEST)) == {"double": "", "float": ""}


def test_a_row_too_far_is_found(tmp_path: Path) -> None:
    export_c(load(SMALLEST), tmp_path, "one")
    source = tmp_path / "one_test.c"
    text = source.read_text()
    broken, count = re.subn(r"k < ROWS", "k <= ROWS", text)
    assert count, text
    source.write_text(broken)
    assert re.search(r"runtime error|AddressSanitizer", said(tmp_path, "one"))
