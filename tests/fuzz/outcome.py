"""What a campaign counts, and what it writes of a violation."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

__all__ = ["Tally", "Violation"]


class Violation(Exception):
    """Something that must not happen, in one line."""


@dataclass
class Tally:
    """Counts by name, and the smallest input of each violation.

    Attributes:
        out: folder of the violations' files.
        counts: of cases, steps, refusals by their first words, and so on.
    """

    out: Path
    counts: Counter[str] = field(default_factory=Counter)
    found: dict[str, Path] = field(default_factory=dict)

    def violation(self, kind: str, seed: int, what: str, case: Any) -> None:
        """Note one and write its input; the same words twice are one."""
        self.counts["violations"] += 1
        words = f"{kind}: {what.splitlines()[0][:160]}"
        key = "".join(c for c in words if not c.isdigit())
        if key in self.found:
            return
        self.out.mkdir(parents=True, exist_ok=True)
        path = self.out / f"{kind}-{seed}.json"
        data = {"kind": kind, "seed": seed, "what": what, "case": case}
        path.write_text(json.dumps(data, indent=1, default=repr) + "\n")
        self.found[key] = path
        print(f"VIOLATION {words}\n  {path}", flush=True)

    def save(self) -> None:
        """The counts so far, into ``counts.json``."""
        self.out.mkdir(parents=True, exist_ok=True)
        counts = {"violations": 0, **dict(sorted(self.counts.items()))}
        (self.out / "counts.json").write_text(json.dumps(counts, indent=1) + "\n")

    def text(self) -> str:
        """One line for each count."""
        width = max((len(name) for name in self.counts), default=0)
        return "\n".join(f"{name:{width}}  {count:>12,}" for name, count in self.counts.items())
