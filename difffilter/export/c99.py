"""``<name>.h``, ``<name>.c``, golden vectors and a self-test of a frozen filter."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief
from difffilter.engine.lower import Lowering
from difffilter.engine.program import Program
from difffilter.engine.trace import Layout, Traced, trace
from difffilter.errors import InputError
from difffilter.export.golden import Golden, golden
from difffilter.export.program import (
    element,
    identifier,
    identifiers,
    literal,
    names,
    places,
    statements,
)
from difffilter.export.templates import GOLDEN, HEADER, SOURCE, TEST
from difffilter.export.words import about, array, comment, frozen_names, frozen_values
from difffilter.files import write_together
from difffilter.filters.filter import Filter
from difffilter.parameters.parameters import Values
from difffilter.scenario.checkpoint import Checkpoint
from difffilter.sensors.stations import StationSensor

__all__ = ["export_c"]

RESULTS = ("innovation", "standardised", "weight", "gate")


def export_c(
    checkpoint: Checkpoint, folder: str | Path, name: str | None = None, single: bool = False
) -> list[Path]:
    """Write the frozen filter as C99; the paths written.

    ``<name>.h`` and ``<name>.c``: the belief, its start, one step; no heap, no library but
    libm, no state of their own. ``<name>_golden.h`` and ``<name>_test.c``: a self-test against
    the torch filter.

    Args:
        folder: made if missing; name: of the files and the prefix of every symbol; the
            scenario's if None.
        single: whether it compiles in float by default, and with ``-D<NAME>_DOUBLE`` in
            double; else in double, and with ``-D<NAME>_FLOAT`` in float.

    Raises:
        InputError: a filter that is told what no sensor tells (clairvoyant, ideal), a place
            that cannot be written (nothing is written then); EngineError: an operation
            without a rule.
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
    zero = torch.zeros((), dtype=torch.float64)
    n = len(filter.states)
    begin = filter.start(torch.zeros(n).double(), torch.eye(n, dtype=torch.float64))
    known = _inputs(checkpoint, filter, constants, begin)
    step = trace(filter, constants, begin, dict.fromkeys(known, zero))
    vectors = golden(checkpoint, known)
    words = {
        "name": name,
        "guard": name.upper(),
        "n": n,
        "m": len(filter.channels),
        "other": "DOUBLE" if single else "FLOAT",
        "other_word": "double" if single else "float",
    }
    header = _header(checkpoint, filter, step, known, name, single)
    files = {
        f"{name}.h": HEADER.format(**words, **header),
        f"{name}.c": SOURCE.format(**words, **_source(filter, constants, step, begin, name)),
        f"{name}_golden.h": GOLDEN.format(**words, **_golden(vectors, known, name)),
        f"{name}_test.c": TEST.format(**words, **_test(known, name)),
    }
    write_together(folder, files)
    return [folder / file for file in files]


def _inputs(
    checkpoint: Checkpoint, filter: Filter, constants: Values, begin: Belief
) -> tuple[str, ...]:
    """Known inputs that a step reads: positions of platforms, columns that the scenario names."""
    platforms = [
        name for sensor in filter.sensors if isinstance(sensor, StationSensor)
        for name in sensor.platform
    ]  # fmt: skip
    possible = tuple(dict.fromkeys((*platforms, *checkpoint.scenario.inputs)))
    zero = torch.zeros((), dtype=torch.float64)
    step = trace(filter, constants, begin, dict.fromkeys(possible, zero))
    read = _read(step, "r")
    at, found = 0, []
    for key, shape in step.row.shapes.items():
        count = step.row.count(shape)
        if key in possible and read & set(range(at, at + count)):
            found.append(key)
        at += count
    return tuple(found)


def _read(step: Traced, group: str) -> set[int]:
    """Places of a group of inputs that belief and record need."""
    live = step.program.live([*step.next_state, *step.results])
    nodes = [step.program.nodes[node] for node in live]
    return {int(str(n[2])) for n in nodes if n[0] == "input" and n[1] == group}


def _header(
    checkpoint: Checkpoint,
    filter: Filter,
    step: Traced,
    known: Sequence[str],
    name: str,
    single: bool,
) -> dict[str, str]:
    fields = []
    for key, field in identifiers(step.state.shapes).items():
        what = {"mean": ", ".join(filter.states), "deviations": "P = X X^T"}.get(
            key, f"memory: {key}"
        )
        sizes = "".join(f"[{size}]" for size in step.state.shapes[key])
        fields.append(f"    {name}_real {field}{sizes}; /* {comment(what)} */")
    extra = [f"    {name}_real {f};" for f in identifiers(known).values()]
    inputs = "/* Known inputs of a row. */\ntypedef struct {\n" + "\n".join(extra)
    guard = name.upper()
    default = (
        f"#if !defined({guard}_FLOAT) && !defined({guard}_DOUBLE)\n#define {guard}_FLOAT\n#endif\n"
    )
    return {
        "about": comment(f"{checkpoint.scenario.name}, system {checkpoint.system}"),
        "version": version("difffilter"),
        "family": about(checkpoint),
        "default": "float" if single else "double",
        "switch": default if single else "",
        "constants": "\n".join(frozen_values(checkpoint, name)),
        "fields": "\n".join(fields),
        "inputs": inputs + f"\n}} {name}_inputs;\n\n" if known else "",
        "argument": _argument(known, name),
    }


def _source(
    filter: Filter, constants: Values, step: Traced, begin: Belief, name: str
) -> dict[str, str]:
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
    read = _read(step, "r")
    head = [
        f"    const REAL z{i} = present[{i}] ? z[{i}] : (REAL)NAN;" for i in range(m) if i in read
    ]
    body = statements(step.program, outputs, lambda group, place: reading[group][place])
    start = _start(filter, begin)
    return {
        "derived": "\n".join(derived),
        "step": "\n".join([*head, *body]),
        "start": "".join(f"{line}\n" for line in start),
        "argument": _argument(known, name),
    }


def _constants(
    filter: Filter, constants: Values, step: Traced, name: str
) -> tuple[list[str], list[str]]:
    """Definitions of what follows from the values, and the text of each constant."""
    used, frozen = _read(step, "c"), frozen_names(filter, name)
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
    nodes = [int(node) for part in found for node in part.reshape(-1)]
    known = identifiers(("mean", "deviations", *begin.memory))
    inputs = names(layout, "belief->", known)
    outputs = places(shapes, "belief->", nodes, known)
    return statements(program, outputs, lambda _, place: inputs[place])


def _golden(vectors: Golden, known: Sequence[str], name: str) -> dict[str, str]:
    log = vectors.log
    inputs = "\n".join(
        _numbers(f"{name}_golden_input_{field}", ("ROWS",), log.inputs[key].reshape(-1))
        for key, field in identifiers(known).items()
    )
    prefix = f"{name}_golden_"
    return {
        "rows": str(log.steps),
        "double": f"{vectors.tolerance[0]:.1e}",
        "single": f"{vectors.tolerance[1]:.1e}",
        "arrays": "\n".join(
            [
                _numbers(prefix + "dt", ("ROWS",), vectors.dt),
                _numbers(prefix + "z", ("ROWS", "M"), log.z.nan_to_num(0.0)),
                _numbers(prefix + "present", ("ROWS", "M"), log.present.to(torch.float64)),
                _numbers(prefix + "mean", ("N",), vectors.mean),
                _numbers(prefix + "deviations", ("N", "N"), vectors.deviations),
                _numbers(prefix + "means", ("ROWS", "N"), vectors.means),
                _numbers(prefix + "covariances", ("ROWS", "N", "N"), vectors.covariances),
                _numbers(prefix + "weights", ("ROWS", "M"), vectors.weights),
                *([inputs] if inputs else []),
            ]
        ),
    }


def _test(known: Sequence[str], name: str) -> dict[str, str]:
    lines = [
        f"        inputs.{field} = ({name}_real){name}_golden_input_{field}[k];"
        for field in identifiers(known).values()
    ]
    return {
        "declare": f"    {name}_inputs inputs;\n" if known else "",
        "fill": "\n".join(lines) + "\n" if lines else "",
        "pass": ", &inputs" if known else "",
    }


def _argument(known: Sequence[str], name: str) -> str:
    return f", const {name}_inputs *inputs" if known else ""


def _numbers(name: str, sizes: Sequence[str], value: Tensor) -> str:
    return array("double", name, sizes, value, repr)
