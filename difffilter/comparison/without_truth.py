"""Systems and sets of values on the same log, by what they foretell of it: no truth is needed.

What cannot be known so is said: an error that all sensors share, or that the motion follows,
foretells itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch

from difffilter.comparison.comparison import Contestant, contestants
from difffilter.comparison.questions import NEXT, OTHERS, Asked, ask
from difffilter.errors import InputError
from difffilter.escape import markdown_table
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.scenario.case import Case
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.scenario.estimation import started
from difffilter.scenario.model import as_case
from difffilter.scenario.sources import Logs, as_log
from difffilter.scoring.foretelling import correlation
from difffilter.scoring.metrics import mean_interval, rejected

__all__ = ["UNKNOWABLE", "Answer", "ChannelCheck", "Untold", "compare_without_truth"]

#: What no log without truth can say.
UNKNOWABLE = (
    "Without truth nobody can know how far the estimates are off: an error that all sensors share, "
    "or that lasts and that the motion follows, foretells itself and is not seen here."
)


@dataclass(frozen=True)
class Answer:
    """How well one system with one set of values answers one question.

    Attributes:
        system, values, question: names.
        score: mean surprise of a measurement, in nats: negative log density, Student's t.
        gain: by how much the reference is more surprised, on the same measurements, with its
            paired 95 % interval over trajectories (blocks of rows of few): above 0 is better.
        squares: mean square of the innovations in sigmas, 1 expected; beyond: share beyond
            1.96 sigmas, 0.05 expected.
        count: of measurements.
    """

    system: str
    values: str
    question: str
    score: float
    gain: float
    gain_ci95: tuple[float, float]
    squares: float
    beyond: float
    count: int


@dataclass(frozen=True)
class ChannelCheck:
    """One channel in the eyes of one system with one set of values.

    Attributes:
        nis: mean square of its innovations in sigmas, 1 expected; beyond: share beyond 1.96
            sigmas, 0.05 expected.
        correlation: of successive innovations, 0 expected; white: 95 % of white ones within.
        rejected: share with a weight below ``REJECTED``.
        apart: mean distance in sigmas from what the other sensors foretell, with its 95 %
            interval; None where they foretell nothing.
    """

    system: str
    values: str
    channel: str
    nis: float
    beyond: float
    correlation: float
    white: float
    rejected: float
    apart: tuple[float, float, float] | None


@dataclass(frozen=True)
class Untold:
    """Result of :func:`compare_without_truth`.

    Attributes:
        scenario: name; trajectories: how many; seconds: of a window.
        reference: label of the row that gains are relative to.
        answers: one for each system, set of values and question; channels: for each channel.
        unasked: why a question could not be asked, by question.
        tracks: of the whole log, by system and values.
    """

    scenario: str
    trajectories: int
    seconds: float
    reference: str
    answers: tuple[Answer, ...]
    channels: tuple[ChannelCheck, ...]
    unasked: Mapping[str, str]
    tracks: Mapping[tuple[str, str], Track]

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        data = {name: value for name, value in vars(self).items() if name != "tracks"}
        for name in ("answers", "channels"):
            data[name] = [dict(vars(one)) for one in data[name]]
        return data | {"unasked": dict(self.unasked), "unknowable": UNKNOWABLE}

    def of(self, system: str, values: str) -> dict[str, Answer]:
        """A system's answers with a set of values, by question."""
        rows = [a for a in self.answers if (a.system, a.values) == (system, values)]
        return {answer.question: answer for answer in rows}

    def cells(self) -> tuple[list[str], list[list[str]]]:
        """Head and rows of the table of answers."""
        head = ["question", "system", "values", "surprise (nats)", f"gain on {self.reference}",
                "95 % interval", "mean square", "beyond 1.96 sigma (%)"]  # fmt: skip
        rows = [
            [
                a.question, a.system, a.values, f"{a.score:.3f}", f"{a.gain:.3f}",
                f"{a.gain_ci95[0]:.3f} to {a.gain_ci95[1]:.3f}", f"{a.squares:.2f}",
                f"{100.0 * a.beyond:.1f}",
            ]
            for a in self.answers
        ]  # fmt: skip
        return head, rows

    def channel_cells(self) -> tuple[list[str], list[list[str]]]:
        """Head and rows of the table of channels."""
        head = ["channel", "system", "values", "mean square", "beyond 1.96 sigma (%)",
                "correlation", "white within", "rejected (%)", "apart from the others (sigma)",
                "95 % interval"]  # fmt: skip
        rows = []
        for c in self.channels:
            apart = ["", ""]
            if c.apart is not None:
                apart = [f"{c.apart[0]:.2f}", f"{c.apart[1]:.2f} to {c.apart[2]:.2f}"]
            rows.append([
                c.channel, c.system, c.values, f"{c.nis:.2f}", f"{100.0 * c.beyond:.1f}",
                f"{c.correlation:.2f}", f"{c.white:.2f}", f"{100.0 * c.rejected:.1f}", *apart,
            ])  # fmt: skip
        return head, rows

    def markdown(self) -> str:
        """Both tables, and what cannot be known."""
        parts = [*markdown_table(*self.cells()), "", *markdown_table(*self.channel_cells()), ""]
        parts += [f"Not asked, {name}: {why}." for name, why in self.unasked.items()]
        return "\n".join([*parts, UNKNOWABLE]) + "\n"


def compare_without_truth(
    scenario: Case | Recipe,
    values: Mapping[str, Checkpoint | None] | None = None,
    *,
    log: Logs,
    systems: tuple[str, ...] = (),
    seconds: float | None = None,
    engine: str = "auto",
) -> Untold:
    """What every system with published values, and every checkpoint's with its own, foretells.

    Each measurement is hidden and asked for, in the ways of
    :data:`difffilter.comparison.questions.QUESTIONS`; truth in the log is not looked at.

    Args:
        scenario, values, systems, engine: as for :func:`difffilter.compare`.
        log: recorded logs.
        seconds: of a hidden window; the tuning's ``ahead``, or three rows if they are longer.

    Raises:
        InputError: no filter among the systems; as for :func:`difffilter.compare`.
    """
    case = as_case(scenario)
    chosen = contestants(case, {"published": None} if values is None else values, systems)
    chosen = [one for one in chosen if isinstance(one.recipe, Recipe)]
    if not chosen:
        raise InputError("compare: found no filter, expected one: others foretell nothing")
    held = as_log(case, log)
    steps = held.intervals()[1:]
    row = float(steps[steps > 0.0].median()) if bool((steps > 0.0).any()) else 0.0
    window = max(case.tuning.ahead, 3.0 * row) if seconds is None else seconds
    asked = {(one.system, one.values): _asked(case, one, held, window, engine) for one in chosen}
    wanted = (case.tuning.system, "published")
    reference = wanted if wanted in asked else next(iter(asked))
    unasked: dict[str, str] = {}
    for one in asked.values():
        unasked |= one.unasked
    return Untold(
        scenario=case.name,
        trajectories=held.trajectories,
        seconds=window,
        reference=" ".join(reference),
        answers=tuple(_answers(asked, reference)),
        channels=tuple(_channels(asked)),
        unasked=unasked,
        tracks={key: one.track for key, one in asked.items()},
    )


def _asked(case: Case, one: Contestant, log: Log, seconds: float, engine: str) -> Asked:
    assert isinstance(one.recipe, Recipe)
    ready = started(case, one.recipe, log, one.frozen)
    temperature = one.temperature
    return ask(one.recipe, ready, one.frozen, seconds, temperature=temperature, engine=engine)


def _answers(
    asked: Mapping[tuple[str, str], Asked], reference: tuple[str, str]
) -> Sequence[Answer]:
    found = []
    questions = dict.fromkeys(name for one in asked.values() for name in one.told)
    for question in questions:
        base = asked[reference].told.get(question)
        for (system, values), one in asked.items():
            told = one.told.get(question)
            if told is None:
                continue
            score, count = told.score().sum(-1), told.present.sum(-1)
            gain, low, high = (float("nan"),) * 3
            if base is not None and base.present.shape == told.present.shape:
                both = base.present & told.present
                apart = torch.where(both, base.score() - told.score(), 0.0).sum(-1)
                gain, low, high = mean_interval(apart, both.sum(-1))
            found.append(
                Answer(
                    system=system,
                    values=values,
                    question=question,
                    score=float(score.sum() / count.sum()),
                    gain=gain,
                    gain_ci95=(low, high),
                    squares=told.squares(),
                    beyond=told.beyond(),
                    count=int(count.sum()),
                )
            )
    return found


def _channels(asked: Mapping[tuple[str, str], Asked]) -> Sequence[ChannelCheck]:
    found = []
    for (system, values), one in asked.items():
        shares = rejected(one.track)
        for i, channel in enumerate(one.track.channels):
            told = one.told[NEXT].only(i)
            others = one.told[OTHERS].only(i) if OTHERS in one.told else None
            apart = None
            if others is not None and bool(others.present.any()):
                apart = mean_interval(others.standardised.sum(-1), others.present.sum(-1))
            found.append(
                ChannelCheck(
                    system=system,
                    values=values,
                    channel=channel,
                    nis=told.squares(),
                    beyond=told.beyond(),
                    correlation=correlation(told),
                    white=1.96 * float(told.present.sum().clamp_min(1)) ** -0.5,
                    rejected=shares[channel],
                    apart=apart,
                )
            )
    return found
