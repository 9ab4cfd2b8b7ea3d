"""In which loop each operation of a program stands, and what must be kept between loops."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from difffilter.engine.functions import CALLS
from difffilter.engine.program import Program

__all__ = ["Schedule", "active_nodes", "schedule"]

#: Operations in one loop: the compiler takes longer over long blocks than their share, so that
#: the largest programs get shorter ones.
SEGMENT, SHORT, LARGE = 300, 100, 6000


@dataclass(frozen=True)
class Schedule:
    """Operations of a step in the order of their execution.

    Attributes:
        setup: nodes that depend on constants alone: once per run.
        segments: the other nodes, loop by loop.
        home: the segment of each node of a segment.
        kept: what a segment reads of those of ``setup``: node to place.
        places: what a later segment reads: node to place; places are used again.
        size: how many places.
    """

    setup: list[int]
    segments: list[list[int]]
    home: dict[int, int]
    kept: dict[int, int]
    places: dict[int, int]
    size: int


def schedule(program: Program, outputs: Sequence[int]) -> Schedule:
    """The schedule of what ``outputs`` need."""
    live = [n for n in program.live(outputs) if program.nodes[n][0] not in ("const", "input")]
    varies = _varying(program, live)
    setup = [node for node in live if node not in varies]
    segments = _segments(program, _ordered(program, [node for node in live if node in varies]))
    home = {node: i for i, segment in enumerate(segments) for node in segment}
    last: dict[int, int] = {}
    kept: dict[int, int] = {}
    for i, segment in enumerate(segments):
        for node in segment:
            for argument in program.arguments(node):
                if argument in home:
                    last[argument] = i
                elif program.nodes[argument][0] not in ("const", "input"):
                    kept.setdefault(argument, len(kept))
    for node in outputs:
        if node not in home and program.nodes[node][0] not in ("const", "input"):
            kept.setdefault(node, len(kept))
    crossing = [node for node in home if last.get(node, 0) > home[node]]
    places, size = _places(crossing, home, last)
    return Schedule(setup, segments, home, kept, places, size)


def active_nodes(
    program: Program, outputs: Sequence[int], constants: set[int], states: set[int]
) -> set[int]:
    """Nodes with a derivative: those that active constants or states reach smoothly."""
    active: set[int] = set()
    for node in program.live(outputs):
        op, *rest = program.nodes[node]
        if op == "input":
            group, place = rest
            if (group == "c" and place in constants) or (group == "s" and place in states):
                active.add(node)
        elif op != "const" and op not in STEPS:
            arguments = program.arguments(node)
            if any(a in active for a in (arguments[1:] if op == "select" else arguments)):
                active.add(node)
    return active


#: Operations whose derivative is zero wherever it is defined.
STEPS = {"lt", "le", "gt", "ge", "eq", "ne", "and", "or", "not", "isnan", "floor"}


def _varying(program: Program, live: Sequence[int]) -> set[int]:
    """Nodes that depend on a state or a row."""
    varies: set[int] = set()
    for node in live:
        for argument in program.arguments(node):
            op, *rest = program.nodes[argument]
            if argument in varies or (op == "input" and rest[0] != "c"):
                varies.add(node)
                break
    return varies


def _ordered(program: Program, live: Sequence[int]) -> list[int]:
    """Nodes by number, but the reciprocal of a root beside it: its derivative reads that."""
    wanted, order, done = set(live), list[int](), set[int]()
    for node in live:
        if node not in done:
            order.append(node)
        inverse = program.reciprocal(node) if program.nodes[node][0] == "sqrt" else None
        if inverse in wanted:
            order.append(inverse)
            done.add(inverse)
    return order


def _segments(program: Program, order: Sequence[int]) -> list[list[int]]:
    segments: list[list[int]] = []
    called, most = False, SHORT if len(order) > LARGE else SEGMENT
    for node in order:
        call = program.nodes[node][0] in CALLS
        if not segments or call != called or len(segments[-1]) >= most:
            segments.append([])
        segments[-1].append(node)
        called = call
    return segments


def _places(
    crossing: Sequence[int], home: dict[int, int], last: dict[int, int]
) -> tuple[dict[int, int], int]:
    """Places for nodes from the segment that makes them to the last that reads them."""
    places: dict[int, int] = {}
    free: list[int] = []
    ending: dict[int, list[int]] = {}
    size, now = 0, -1
    for node in sorted(crossing, key=lambda n: (home[n], n)):
        while now < home[node]:
            # Free only after the segment that reads it last.
            free += ending.pop(now, [])
            now += 1
        if free:
            place = free.pop()
        else:
            place, size = size, size + 1
        places[node] = place
        ending.setdefault(last[node], []).append(place)
    return places, size
