"""What fills the source of an exported filter: constants, the start, the step."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from torch import Tensor

from difffilter.core.beliefs import Belief
from difffilter.engine.lower import Lowering
from difffilter.engine.program import Program
from difffilter.engine.trace import Layout, Traced
from difffilter.export.header import argument
from difffilter.export.program import (
    element,
    identifiers,
    literal,
    names,
    places,
    statements,
)
from difffilter.export.words import array, frozen_names
from difffilter.filters.recipe import Recipe
from difffilter.parameters.values import Constants

__all__ = ["read_places", "source"]

RESULTS = ("innovation", "standardised", "weight", "gate")


def read_places(step: Traced, group: str) -> set[int]:
    """Places of a group of inputs that belief and record need."""
    live = step.program.live([*step.next_state, *step.results])
    nodes = [step.program.nodes[node] for node in live]
    return {int(str(n[2])) for n in nodes if n[0] == "input" and n[1] == group}


def source(
    filter: Recipe, constants: Constants, step: Traced, begin: Belief, name: str
) -> dict[str, str]:
    """What fills the source."""
    step = _folded(step, constants, frozen_names(filter, name))
    derived, numbers = _constants(filter, constants, step, name)
    known = [key for key in step.row.shapes if key not in ("z", "dt")]
    fields, state = identifiers(known), identifiers(step.state.shapes)
    m = len(filter.channels)
    row = [*(f"z{i}" for i in range(m)), "dt", *(f"inputs->{fields[key]}" for key in known)]
    reading = {"c": numbers, "s": names(step.state, "belief->", state), "r": row}
    results: dict[str, int] = {}
    at = 0
    for key, shape in step.output.shapes.items():
        count = step.output.count(shape)
        if key in RESULTS:
            nodes = step.results[at : at + count]
            results |= places(Layout({key: shape}), "made.", nodes, {key: key})
        at += count
    outputs = places(step.state, "after.", step.next_state, state) | results
    read = read_places(step, "r")
    head = [
        f"    const REAL z{i} = present[{i}] ? z[{i}] : (REAL)NAN;" for i in range(m) if i in read
    ]
    body = statements(step.program, outputs, lambda group, place: reading[group][place])
    start = _start(filter, begin)
    return {
        "derived": "\n".join(derived),
        "step": "\n".join([*head, *body]),
        "start": "".join(f"{line}\n" for line in start),
        "argument": argument(known, name),
    }


def _folded(step: Traced, constants: Constants, frozen: Mapping[str, Sequence[str]]) -> Traced:
    """The step without the terms that an entry 0 of what follows from the values takes away."""
    zeros, at = set(), 0
    for key, shape in step.constants.shapes.items():
        numbers = constants[key].detach().reshape(-1).tolist()
        if len(frozen.get(key, ())) != len(numbers):
            zeros |= {at + i for i, number in enumerate(numbers) if number == 0.0}
        at += step.constants.count(shape)
    program, made = Program(), {}
    for node in step.program.live([*step.next_state, *step.results]):
        op, *rest = step.program.nodes[node]
        if op == "const":
            made[node] = program.const(step.program.value(node) or 0.0)
        elif op == "input":
            group, place = str(rest[0]), int(str(rest[1]))
            zero = group == "c" and place in zeros
            made[node] = program.const(0.0) if zero else program.input(group, place)
        else:
            made[node] = program.make(str(op), *(made[a] for a in step.program.arguments(node)))
    return replace(
        step,
        program=program,
        next_state=[made[node] for node in step.next_state],
        results=[made[node] for node in step.results],
    )


def _constants(
    filter: Recipe, constants: Constants, step: Traced, name: str
) -> tuple[list[str], list[str]]:
    """Definitions of what follows from the values, and the text of each constant."""
    used, frozen = read_places(step, "c"), frozen_names(filter, name)
    own = identifiers(f"d_{key}" for key in step.constants.shapes)
    lines: list[str] = []
    reading: list[str] = []
    for key, shape in step.constants.shapes.items():
        count, value = step.constants.count(shape), constants[key].detach()
        if key in frozen and len(frozen[key]) == count:
            reading += frozen[key]
            continue
        macro = own[f"d_{key}"].upper()
        if used & set(range(len(reading), len(reading) + count)):
            lines.append(array("REAL", macro, shape, value, literal))
        reading += [element(macro, shape, i) for i in range(count)]
    return lines, reading


def _start(filter: Recipe, begin: Belief) -> list[str]:
    """Statements that set the memory of a belief as :meth:`Recipe.start` does."""
    if not begin.memory:
        return []

    def memory(mean: Tensor, deviations: Tensor) -> list[Tensor]:
        return list(filter.start(mean, deviations).memory.values())

    program = Program()
    layout = Layout({"mean": tuple(begin.mean.shape), "deviations": tuple(begin.deviations.shape)})
    tensors = (begin.mean, begin.deviations)
    given = list(zip(tensors, layout.inputs(program, "s"), strict=True))
    found = Lowering(program).run(memory, given)
    shapes = Layout({key: tuple(value.shape) for key, value in begin.memory.items()})
    nodes = [int(node) for part in found for node in part.reshape(-1)]
    known = identifiers(("mean", "deviations", *begin.memory))
    inputs = names(layout, "belief->", known)
    outputs = places(shapes, "belief->", nodes, known)
    return statements(program, outputs, lambda _, place: inputs[place])
