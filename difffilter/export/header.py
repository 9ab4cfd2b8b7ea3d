"""What fills the header of an exported filter."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.metadata import version

from difffilter.engine.trace import Traced
from difffilter.escape import c_comment
from difffilter.export.program import identifiers
from difffilter.export.words import about, frozen_values
from difffilter.filters.recipe import Recipe
from difffilter.scenario.checkpoint import Checkpoint

__all__ = ["argument", "header"]

UNUSABLE = """\
#ifdef {guard}_FLOAT
#error "float has too few digits for these positions: export relative to an origin (--origin)"
#endif
"""


def header(
    checkpoint: Checkpoint,
    filter: Recipe,
    step: Traced,
    known: Sequence[str],
    *,
    name: str,
    single: bool,
    usable: bool,
    origin: Sequence[float],
) -> dict[str, str]:
    """What fills the header.

    Args:
        usable: whether float has digits enough for the filter's numbers.
        origin: to which positions are relative, if any.
    """
    fields = []
    for key, field in identifiers(step.state.shapes).items():
        what = {"mean": ", ".join(filter.states), "deviations": "P = X X^T"}.get(
            key, f"memory: {key}"
        )
        sizes = "".join(f"[{size}]" for size in step.state.shapes[key])
        fields.append(f"    {name}_real {field}{sizes}; /* {c_comment(what)} */")
    extra = [f"    {name}_real {f};" for f in identifiers(known).values()]
    inputs = "/* Known inputs of a row. */\ntypedef struct {\n" + "\n".join(extra)
    guard = name.upper()
    default = (
        f"#if !defined({guard}_FLOAT) && !defined({guard}_DOUBLE)\n#define {guard}_FLOAT\n#endif\n"
    )
    errors = filter.error_states
    rows = f"#define {guard}_ERRORS {len(errors)} /* rows of deviations: {', '.join(errors)} */\n"
    return {
        "errors": "" if errors == filter.states else rows,
        "about": c_comment(f"{checkpoint.scenario.name}, system {checkpoint.system}"),
        "version": version("difffilter"),
        "family": about(checkpoint),
        "default": "float" if single else "double",
        "switch": default if single else "",
        "unusable": "" if usable else UNUSABLE.format(guard=guard),
        "origin": _origin(origin, name),
        "constants": "\n".join(frozen_values(checkpoint, name)),
        "fields": "\n".join(fields),
        "inputs": inputs + f"\n}} {name}_inputs;\n\n" if known else "",
        "argument": argument(known, name),
    }


def _origin(origin: Sequence[float], name: str) -> str:
    if not origin:
        return ""
    numbers = ", ".join(repr(float(number)) for number in origin)
    return (
        "\n/* Positions are relative to this, m: subtract it from measured positions, from the\n"
        "   start's and from those of platforms, and add it to those of the belief. */\n"
        f"static const double {name.upper()}_ORIGIN[{len(origin)}] = {{{numbers}}};\n"
    )


def argument(known: Sequence[str], name: str) -> str:
    """The argument of a step for known inputs."""
    return f", const {name}_inputs *inputs" if known else ""
