"""What is claimed, asked and got: held or not, as measured."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from difffilter.bench.findings import Findings
from difffilter.bench.job import FUSED, IMQ, M_EKF
from difffilter.bench.sizes import Sizes

__all__ = ["Claim", "claims"]

#: MiB below which memory is the same.
SLACK = 1.0
#: Steps and trajectories that the claims of speed are about.
STEPS, BATCH = 100, 4096


@dataclass(frozen=True)
class Claim:
    """One claim.

    Attributes:
        held: None where this run did not measure it.
        got: the numbers that decide.
    """

    text: str
    held: bool | None
    got: dict[str, Any]


def claims(found: Findings, sizes: Sizes) -> list[Claim]:
    """In the order of the report."""
    step = found.streaming.get((FUSED, IMQ))
    return [
        _ratio(found, "gradient", "value and gradient", 30.0),
        _ratio(found, "value", "forward", 20.0),
        _m_ekf(found),
        _memory(found, sizes),
        _limit("a streamed step takes at most 20 us", 20.0, step, "us"),
        *_compiled(found, sizes),
        _limit(
            "tuning airport-mlat-intermittent takes less than 10 s with a warm cache",
            10.0,
            found.tuning["s"] if found.tuning else None,
            "s",
        ),
    ]


def _ratio(found: Findings, kind: str, name: str, asked: float) -> Claim:
    own = found.speed(FUSED, IMQ, STEPS, BATCH)
    peers = [found.speed(f"JAX, {form}", IMQ, STEPS, BATCH) for form in ("textbook", "sequential")]
    times = [getattr(one, kind) for one in peers if one is not None]
    best = min((time for time in times if time is not None), default=None)
    got = None if own is None or best is None else best / getattr(own, kind)
    text = f"{name}: {asked:g} times as fast as the better form of JAX (T = {STEPS}, B = {BATCH})"
    return Claim(text, None if got is None else got >= asked, {"asked": asked, "got": got})


def _m_ekf(found: Findings) -> Claim:
    one = found.speed(FUSED, M_EKF, STEPS, BATCH)
    text = f"M-EKF: value and gradient in at most 2.5 us (T = {STEPS}, B = {BATCH})"
    return _limit(text, 2.5, one.gradient if one else None, "us")


def _memory(found: Findings, sizes: Sizes) -> Claim:
    short, long, batch = sizes.memory
    before, after = found.memory[FUSED, IMQ]
    held = None if before is None or after is None else after <= 1.1 * before + SLACK
    text = (
        f"value and gradient take the same memory at T = {short} and T = {long} (B = {batch}; "
        f"within 10 %, or {SLACK:g} MiB)"
    )
    return Claim(text, held, {f"MiB at T = {short}": before, f"MiB at T = {long}": after})


def _compiled(found: Findings, sizes: Sizes) -> list[Claim]:
    made = []
    for name, (cold, warm) in found.compiled.items():
        asked = 20.0 if name == IMQ else 60.0
        text = f"{name}: traced and compiled in less than {asked:g} s"
        if cold is None:
            made.append(Claim(text, False, {"asked, s": asked, "got": f"> {sizes.patience:g} s"}))
        else:
            made.append(_limit(text, asked, cold["gradient"], "s"))
        text = f"{name}: a start from the cache takes less than 1 s beyond importing torch"
        start = None if warm is None else warm["library and filter"] + warm["gradient"]
        made.append(_limit(text, 1.0, start, "s"))
    return made


def _limit(text: str, asked: float, got: float | None, unit: str) -> Claim:
    return Claim(text, None if got is None else got <= asked, {f"asked, {unit}": asked, "got": got})
