"""What a benchmark found, and how it is measured."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

from difffilter.bench.child import compile_times, measured
from difffilter.bench.job import FUSED, IMQ, PLAIN, TASKS, TORCH, problem, task
from difffilter.bench.measure import agree, interleaved
from difffilter.bench.peers import contenders
from difffilter.bench.sizes import Sizes
from difffilter.bench.stream import latencies

__all__ = ["KINDS", "Findings", "Speed", "measure"]

KINDS = ("value", "gradient")
AIRPORT = "airport-mlat-intermittent"
#: s after which a memory measurement, and a tuning, are given up.
MEMORY_PATIENCE, TUNING_PATIENCE = 60.0, 600.0

Times = dict[str, float] | None


@dataclass(frozen=True)
class Speed:
    """A contender's time for one size of a job: us per filter step and trajectory.

    Attributes:
        value, gradient: None where it was not run: it has none, or it would take minutes.
    """

    filter: str
    steps: int
    batch: int
    contender: str
    value: float | None = None
    gradient: float | None = None


@dataclass
class Findings:
    """All that was measured.

    Attributes:
        speeds: one per contender and size.
        memory: MiB by (contender, filter), at both lengths; None for too long.
        streaming: us per step by (contender, filter).
        compiled: seconds by filter, with an empty cache and with a full one; None for longer
            than the patience.
        tuning: of the airport; None where it was left out or took too long.
    """

    speeds: list[Speed] = field(default_factory=list)
    memory: dict[tuple[str, str], tuple[float | None, float | None]] = field(default_factory=dict)
    streaming: dict[tuple[str, str], float] = field(default_factory=dict)
    compiled: dict[str, tuple[Times, Times]] = field(default_factory=dict)
    tuning: Times = None

    def speed(self, contender: str, filter: str, steps: int, batch: int) -> Speed | None:
        """Of one contender and size."""
        key = (filter, steps, batch, contender)
        for one in self.speeds:
            if (one.filter, one.steps, one.batch, one.contender) == key:
                return one
        return None

    def best_other(self, one: Speed, kind: str, own: str = "difffilter") -> float | None:
        """The best time for the same job by another library than ``own``."""
        mine = one.contender.startswith(own)
        others = [
            getattr(other, kind)
            for other in self.speeds
            if (other.filter, other.steps, other.batch) == (one.filter, one.steps, one.batch)
            and other.contender != one.contender
            and not (mine and other.contender.startswith(own))
        ]
        return min((time for time in others if time is not None), default=None)


def measure(sizes: Sizes, peers: Iterable[str], stage: Callable[[str], None]) -> Findings:
    """Everything, one part after the other; ``stage`` is told what begins.

    Raises:
        DisagreementError: contenders that do not compute the same.
    """
    found, peers = Findings(), tuple(peers)
    for steps, batch in sizes.speed:
        for name in TASKS:
            stage(f"speed: {name}, T = {steps}, B = {batch}")
            found.speeds += _speeds(name, steps, batch, sizes, peers)
    for who, name in _remembering(peers)[: sizes.remembering]:
        stage(f"memory: {who}")
        short, long = (_memory(who, name, steps, sizes.memory[2]) for steps in sizes.memory[:2])
        found.memory[who, name] = (short, long)
    stage("streaming")
    found.streaming = latencies(peers, sizes.repetitions)
    for name in sizes.compiled:
        stage(f"compile: {name}")
        found.compiled[name] = compile_times(name, sizes.patience)
    if sizes.tuning is not None:
        stage(f"tuning: {AIRPORT}")
        found.tuning = measured("tuning", TUNING_PATIENCE, scenario=AIRPORT, settings=sizes.tuning)
    return found


def _remembering(peers: tuple[str, ...]) -> list[tuple[str, str]]:
    """Whose memory is measured, and with which filter: those that have a gradient."""
    found = [(FUSED, IMQ), (TORCH, IMQ)]
    if "jax" in peers:
        found += [("JAX, textbook", IMQ), ("JAX, sequential", IMQ)]
    if "dynamax" in peers:
        found += [("dynamax", PLAIN)]
    return found


def _memory(contender: str, filter: str, steps: int, batch: int) -> float | None:
    found = measured(
        "memory", MEMORY_PATIENCE, contender=contender, filter=filter, steps=steps, batch=batch
    )
    return None if found is None else found["MiB"]


def _speeds(
    filter: str, steps: int, batch: int, sizes: Sizes, peers: tuple[str, ...]
) -> list[Speed]:
    made = contenders(task(filter, problem(steps, batch)), peers, ("fused", "torch"))
    agree(made, steps, batch)
    calls: dict[tuple[int, str], Callable[[], object]] = {}
    for i, one in enumerate(made):
        for kind, call in zip(KINDS, (one.value, one.gradient), strict=True):
            if call is not None and one.takes(kind, steps, batch):
                calls[i, kind] = call
    seconds = interleaved(calls, sizes.repetitions, sizes.seconds)
    times = {key: 1e6 * found / (steps * batch) for key, found in seconds.items()}
    return [
        Speed(filter, steps, batch, one.name, times.get((i, "value")), times.get((i, "gradient")))
        for i, one in enumerate(made)
    ]
