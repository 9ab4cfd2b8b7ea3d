"""Which engine runs: as asked, or the compiled one where it can and pays."""

from __future__ import annotations

import os
from collections.abc import Callable
from typing import TypeVar

from difffilter.engine.build import compiler
from difffilter.engine.notice import tell
from difffilter.errors import EngineError, InputError
from difffilter.logs.log import Rows

__all__ = ["ENGINES", "eager_seconds", "pick", "settled", "tell", "tried", "with_engine"]

ENGINES = ("auto", "torch", "fused")
#: s of torch's time from which ``auto`` compiles: the engine takes a tenth of it or less.
ENOUGH = 0.1

Result = TypeVar("Result")


def eager_seconds(log: Rows) -> float:
    """About what torch takes to run a log, s: a formula, so that the choice is always the same.

    A filter's iterations are left out: they lengthen torch's time and the compiler's alike.
    """
    return log.steps * (1e-3 + 3e-6 * log.trajectories)


def pick(engine: str, seconds: float) -> str:
    """``torch``, ``fused``, or ``auto`` where the compiled engine is to be tried.

    Args:
        engine: as asked for; the environment's ``DIFFFILTER_ENGINE`` stands in for ``auto``.
        seconds: about what torch would take for the job.

    Raises:
        InputError: an unknown engine.
    """
    if engine == "auto":
        engine = os.environ.get("DIFFFILTER_ENGINE", "auto")
    if engine not in ENGINES:
        raise InputError(f"engine: found {engine!r}, expected one of {', '.join(ENGINES)}")
    if engine == "auto" and (seconds < ENOUGH or compiler() is None):
        return "torch"
    return engine


def with_engine(
    engine: str, fused: Callable[[], Result], plain: Callable[[], Result], seconds: float
) -> Result:
    """The result of the engine that was picked; ``auto`` falls back to torch and says so once."""
    chosen = pick(engine, seconds)
    found = tried(chosen, fused)
    return plain() if found is None else found[0]


def settled(engine: str, trial: Callable[[], object], seconds: float) -> str:
    """The engine of many runs: ``auto`` is fused where it pays and a trial of it succeeds."""
    chosen = pick(engine, seconds)
    if chosen != "auto":
        return chosen
    return "torch" if tried(chosen, trial) is None else "fused"


def tried(chosen: str, fused: Callable[[], Result]) -> tuple[Result] | None:
    """What the compiled engine gives; None for torch, chosen or fallen back to."""
    if chosen == "torch":
        return None
    try:
        return (fused(),)
    except EngineError as error:
        if chosen == "fused":
            raise
        tell(error)
        return None
