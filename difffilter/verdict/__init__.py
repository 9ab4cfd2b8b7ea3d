"""Whether to adopt tuned values, and at what risk."""

from __future__ import annotations

from difffilter.verdict.judge import write_index

__all__ = ["write_index"]
