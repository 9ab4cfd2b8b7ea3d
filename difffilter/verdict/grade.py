"""The advice in three grades, by a rule (docs/verdict.md has it in words)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from difffilter.comparison.table import Row
from difffilter.verdict.flags import Flag
from difffilter.verdict.stresses import NOT_STATED, Stressed

__all__ = ["ADOPT", "GRADES", "IF", "KEEP", "Grade", "Term", "grade", "harmful"]

ADOPT, IF, KEEP = "adopt", "adopt if", "keep"
#: Best first.
GRADES = (ADOPT, IF, KEEP)
#: A condition that is surely worse by more than this forbids a plain adopt.
WORSE = 1.1
#: A stated condition that is surely worse by more than this says keep.
RUINOUS = 2.0
#: RMSE at most this much larger where values are adopted for their covariance.
SAME = 1.03
#: NEES along a direction from which a condition misleads, and times the published one's.
MISLED, TIMES = 9.0, 3.0


@dataclass(frozen=True)
class Term:
    """One condition of an *adopt if*.

    Attributes:
        text: what must hold, or what was found, in plain words.
        cost: what it costs when it fails.
        monitor: what to watch in operation.
        keep: parameters to keep as published to avoid it.
        plausible: why it may happen; "" for a red flag.
    """

    text: str
    cost: str
    monitor: str
    keep: tuple[str, ...] = ()
    plausible: str = ""


@dataclass(frozen=True)
class Grade:
    """What to do, and why.

    Attributes:
        word: one of ``GRADES``; why: one sentence; terms: conditions of an *adopt if*, and of a
            *keep* what else speaks against.
    """

    word: str
    why: str
    terms: tuple[Term, ...] = ()
    spare: tuple[str, ...] = field(default=())

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return asdict(self)

    @property
    def text(self) -> str:
        """All in one paragraph."""
        parts = [f"{self.word[0].upper()}{self.word[1:]}: {self.why}"]
        for term in self.terms:
            keep = f"; to avoid it keep {', '.join(term.keep)} as published" if term.keep else ""
            parts.append(f"{term.text} ({term.cost}; watch {term.monitor}{keep})")
        if self.spare:
            parts.append(f"at its published value costs nothing: {', '.join(self.spare)}")
        return ". ".join(parts) + "."


def harmful(one: Stressed) -> bool:
    """Whether a condition is surely worse than published by more than 10 %, or misleads."""
    return one.ratio[1] > WORSE or bool(misled(one))


def misled(one: Stressed) -> dict[str, tuple[float, float]]:
    """Directions along which the tuned filter claims a third of its errors or less, and
    the published one does not."""
    return {
        name: (before, after)
        for name, (before, after) in one.directions.items()
        if after > MISLED and (math.isnan(before) or after > TIMES * before)
    }


def grade(
    published: Row,
    tuned: Row,
    flags: Sequence[Flag],
    stressed: Sequence[Stressed],
    cures: Mapping[str, tuple[str, ...]] | None = None,
    spare: Sequence[str] = (),
) -> Grade:
    """The grade of tuned values.

    Args:
        published, tuned: held out; the tuned row's ratio is relative to the published one.
        flags: red ones; stressed: conditions that were tested.
        cures: parameters which, as published, avoid a condition, by its name.
        spare: parameters whose published values cost nothing.
    """
    low, high = tuned.ratio_ci95
    gain = f"RMSE held out is {tuned.ratio:.3f} of the published values' ({low:.3f} to {high:.3f})"
    before, after = published.nees_per_state, tuned.nees_per_state
    mended = _fair(after) and not _fair(before) and tuned.ratio <= SAME
    terms = [Term(flag.text, flag.cost, flag.monitor, flag.keep) for flag in flags]
    harm = [one for one in stressed if one.decisive and harmful(one)]
    terms += [_term(one, (cures or {}).get(one.name, ())) for one in harm]
    kept = tuple(spare)
    if high >= 1.0 and not mended:
        why = "the tuned values lose" if low > 1.0 else "tuning wins nothing that is sure"
        return Grade(KEEP, f"{why}; {gain}", tuple(terms))
    ruin = [one for one in harm if one.plausible != NOT_STATED and one.ratio[1] > RUINOUS]
    if ruin:
        worst = max(ruin, key=lambda one: one.ratio[0])
        why = f"{worst.text} ({worst.plausible}) multiplies the error by {worst.ratio[0]:.3g}"
        return Grade(KEEP, f"{why}; {gain}", tuple(terms))
    if high >= 1.0:
        gain = f"for their covariance (NEES {before:.3g} to {after:.3g}); {gain}"
    return Grade(IF if terms else ADOPT, gain, tuple(terms), kept)


def _term(one: Stressed, keep: tuple[str, ...]) -> Term:
    error = [f"{value:.3g} {one.unit}".rstrip() for value in (one.tuned, one.published)]
    cost = f"RMSE {error[0]}, published {error[1]}"
    wrong = misled(one)
    if wrong:
        name, (before, after) = max(wrong.items(), key=lambda item: item[1][1])
        cost += f"; the covariance misleads, {name}: NEES {after:.3g}, published {before:.3g}"
    return Term(f"not under {one.text}", cost, one.monitor, keep, one.plausible)


def _fair(nees: float) -> bool:
    return math.isfinite(nees) and 0.5 <= nees <= 2.0
