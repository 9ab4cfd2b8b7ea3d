"""``<name>.h``, ``<name>.c``, golden vectors and a self-test of a frozen filter."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor

from difffilter.belief import Belief
from difffilter.checkpoint import Checkpoint
from difffilter.engine.lower import Lowering
from difffilter.engine.program import Program
from difffilter.engine.trace import Layout, Traced, trace
from difffilter.errors import InputError
from difffilter.export.golden import Golden, golden
from difffilter.export.program import identifier, names, places, statements
from difffilter.export.templates import GOLDEN, HEADER, SOURCE, TEST
from difffilter.files import write_atomically
from difffilter.filter import Filter
from difffilter.parameters import Values
from difffilter.station_sensor import StationSensor

__all__ = ["export_c", "frozen_values"]

RESULTS = ("innovation", "standardised", "weight", "gate")


def export_c(checkpoint: Checkpoint, folder: str | Path, name: str | None = None) -> list[Path]:
    """Write the frozen filter as C99; the paths written.

    ``<name>.h`` and ``<name>.c``: the belief, its start, one step; no heap, no library but
    libm, no state of their own. ``-D<NAME>_FLOAT`` compiles them in float.
    ``<name>_golden.h`` and ``<name>_test.c``: a self-test against the torch filter.

    Args:
        folder: made if missing; name: of the files and the prefix of every symbol; the
            scenario's if None.

    Raises:
        InputError: a filter that is told what no sensor tells (clairvoyant, ideal), a place
            that cannot be written; EngineError: an operation without a rule.
    """
    filter, folder = checkpoint.published_filter, Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"{folder}: found a file, expected a folder")
    if filter.clairvoyant or getattr(filter.adaptation, "ideal", False):
        raise InputError(
            f"export: {checkpoint.system} is told of faults, expected a deployable one"
        )
    name = identifier(name or checkpoint.scenario.name)
    constants = filter.prepare(checkpoint.values, checkpoint.temperature)
    known = _inputs(filter)
    zero = torch.zeros((), dtype=torch.float64)
    n = len(filter.states)
    begin = filter.start(torch.zeros(n).double(), torch.eye(n, dtype=torch.float64))
    step = trace(filter, constants, begin, dict.fromkeys(known, zero))
    vectors = golden(checkpoint, known)
    words = {"name": name, "guard": name.upper(), "n": n, "m": len(filter.channels)}
    files = {
        f"{name}.h": HEADER.format(**words, **_header(checkpoint, filter, step, known, name)),
        f"{name}.c": SOURCE.format(**words, **_source(filter, constants, step, begin, name)),
        f"{name}_golden.h": GOLDEN.format(**words, **_golden(vectors, known, name)),
        f"{name}_test.c": TEST.format(**words, **_test(known, name)),
    }
    for file, content in files.items():
        write_atomically(folder / file, content)
    return [folder / file for file in files]


def _inputs(filter: Filter) -> tuple[str, ...]:
    """Known inputs that a step reads: the positions of platforms."""
    found = [
        name for sensor in filter.sensors if isinstance(sensor, StationSensor)
        for name in sensor.platform
    ]  # fmt: skip
    return tuple(dict.fromkeys(found))


def frozen_values(checkpoint: Checkpoint, name: str) -> list[str]:
    """A definition of each frozen value, with its unit and source."""
    lines = []
    for key, parameter in checkpoint.published_filter.declarations.items():
        flat = checkpoint.values[key].reshape(-1).tolist()
        source = f"; {parameter.source}" if parameter.source and not parameter.tuned else ""
        for entry, value in zip(parameter.entries(), flat, strict=True):
            unit = parameter.unit if parameter.unit != "1" else "no unit"
            text = f"/* {unit}{', tuned' if parameter.tuned else ''}{_comment(source)} */"
            lines.append(f"#define {_macro(name, entry)} {value!r} {text}")
    return lines


def _header(
    checkpoint: Checkpoint, filter: Filter, step: Traced, known: Sequence[str], name: str
) -> dict[str, str]:
    fields = []
    for key, shape in step.state.shapes.items():
        what = {"mean": ", ".join(filter.states), "deviations": "P = X X^T"}.get(key, "memory")
        dimensions = "".join(f"[{size}]" for size in shape)
        fields.append(f"    {name}_real {identifier(key)}{dimensions}; /* {what} */")
    extra = [f"    {name}_real {identifier(x)};" for x in known]
    inputs = "typedef struct {\n" + "\n".join(extra) + f"\n}} {name}_inputs;\n" if known else ""
    about = f"{checkpoint.scenario.name}, system {checkpoint.system}"
    return {
        "about": _comment(about),
        "version": version("difffilter"),
        "channels": ", ".join(filter.channels),
        "constants": "\n".join(frozen_values(checkpoint, name)),
        "fields": "\n".join(fields),
        "inputs": inputs,
        "argument": _argument(known, name),
    }


def _source(
    filter: Filter, constants: Values, step: Traced, begin: Belief, name: str
) -> dict[str, str]:
    derived, reading = _constants(filter, constants, step, name)
    rows = names(step.row, "")

    def text(group: str, place: int) -> str:
        if group == "c":
            return reading[place]
        if group == "s":
            return names(step.state, "belief->")[place]
        entry = rows[place]
        if entry.startswith("z["):
            at = entry[2:-1]
            return f"z{at}"
        return entry if entry == "dt" else f"inputs->{entry}"

    results: dict[str, int] = {}
    at = 0
    for key, shape in step.output.shapes.items():
        count = step.output.count(shape)
        if key in RESULTS:
            own = Layout({key: shape})
            results |= places(own, "made.", step.results[at : at + count])
        at += count
    outputs = places(step.state, "after.", step.next_state) | results
    body = statements(step.program, outputs, text)
    m = len(filter.channels)
    head = [f"    const REAL z{i} = present[{i}] ? z[{i}] : NAN;" for i in range(m)]
    used = {line for i in range(m) for line in body if f"z{i}" in line}
    return {
        "derived": "\n".join(derived),
        "step": "\n".join([*(head if used else []), *body]),
        "start": "\n".join(_start(filter, begin)),
        "argument": _argument(_inputs(filter), name),
    }


def _constants(
    filter: Filter, constants: Values, step: Traced, name: str
) -> tuple[list[str], list[str]]:
    """Definitions of what follows from the values, and the text of each constant."""
    wanted = [*step.next_state, *step.results]
    used = {
        int(str(rest[1]))
        for node in step.program.live(wanted)
        for op, *rest in [step.program.nodes[node]]
        if op == "input" and rest[0] == "c"
    }
    lines, reading = [], []
    for key, shape in step.constants.shapes.items():
        flat = constants[key].detach().reshape(-1).tolist()
        declared = filter.declarations.get(key)
        entries = declared.entries() if declared else []
        for i in range(step.constants.count(shape)):
            if declared and len(entries) == len(flat):
                reading.append(f"(REAL){_macro(name, entries[i])}")
                continue
            macro = f"D_{identifier(key).upper()}_{i}"
            if len(reading) in used:
                lines.append(f"#define {macro} (REAL)({flat[i]!r})")
            reading.append(macro)
    return lines, reading


def _start(filter: Filter, begin: Belief) -> list[str]:
    """Statements that set the memory of a belief as :meth:`Filter.start` does."""
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
    nodes = [int(node) for array in found for node in array.reshape(-1)]
    inputs = names(layout, "belief->")
    return statements(program, places(shapes, "belief->", nodes), lambda _, place: inputs[place])


def _golden(vectors: Golden, known: Sequence[str], name: str) -> dict[str, str]:
    log = vectors.log
    inputs = "\n".join(
        _array(f"{name}_golden_{identifier(key)}", log.inputs[key].reshape(-1), ("ROWS",))
        for key in known
    )
    prefix = f"{name}_golden_"
    return {
        "rows": str(log.steps),
        "double": f"{vectors.tolerance[0]:.1e}",
        "single": f"{vectors.tolerance[1]:.1e}",
        "arrays": "\n".join(
            [
                _array(prefix + "dt", vectors.dt, ("ROWS",)),
                _array(prefix + "z", log.z.nan_to_num(0.0), ("ROWS", "M")),
                _array(prefix + "present", log.present.to(torch.float64), ("ROWS", "M")),
                _array(prefix + "mean", vectors.mean, ("N",)),
                _array(prefix + "deviations", vectors.deviations, ("N", "N")),
                _array(prefix + "means", vectors.means, ("ROWS", "N")),
                _array(prefix + "covariances", vectors.covariances, ("ROWS", "N", "N")),
                *([inputs] if inputs else []),
            ]
        ),
    }


def _test(known: Sequence[str], name: str) -> dict[str, str]:
    lines = [
        f"        inputs.{identifier(key)} = ({name}_real){name}_golden_{identifier(key)}[k];"
        for key in known
    ]
    return {
        "declare": f"    {name}_inputs inputs;\n" if known else "",
        "fill": "\n".join(lines) + "\n" if lines else "",
        "pass": ", &inputs" if known else "",
    }


def _argument(known: Sequence[str], name: str) -> str:
    return f", const {name}_inputs *inputs" if known else ""


def _array(name: str, values: Tensor, sizes: Sequence[str]) -> str:
    dimensions = "".join(f"[{size}]" for size in sizes)

    def braces(x: Tensor) -> str:
        if x.dim() == 0:
            return repr(float(x))
        return "{" + ", ".join(braces(part) for part in x) + "}"

    return f"static const double {name}{dimensions} = {braces(values)};"


def _macro(name: str, entry: str) -> str:
    return f"{name}_{identifier(entry)}".upper()


def _comment(text: str) -> str:
    return text.replace("*/", "* /")
