"""What the comments and constants of an exported filter say."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence

from torch import Tensor

from difffilter.escape import c_comment as comment
from difffilter.export.program import identifiers
from difffilter.filters.mixture import Mixture
from difffilter.filters.recipe import Recipe
from difffilter.scenario.checkpoint import Checkpoint

__all__ = ["about", "array", "frozen_names", "frozen_values"]

#: Names of the header that no constant may take.
OWN = (
    "real", "belief", "inputs", "result", "start", "step", "states", "channels", "float",
    "double", "h", "golden",
)  # fmt: skip
RULES = {
    "taylor": "extended Kalman filter (first-order Taylor), square-root form",
    "cubature": "square-root cubature Kalman filter",
}


def about(checkpoint: Checkpoint) -> str:
    """Lines of a comment: the family of the filter, its options, channels and units."""
    filter, spec = checkpoint.published_filter, checkpoint.scenario.systems[checkpoint.system]
    options = [
        f"{key} {value if isinstance(value, str) else ', '.join(value)}"
        for key in ("weight", "standardise", "gate", "recovery", "adaptation", "fusion")
        for value in [spec.options.get(key)]
        if value and value not in ("none", "plain")
    ]
    if filter.iterations:
        options.append(f"{filter.iterations} reweightings (M-EKF)")
    options += [
        word
        for word, present in (
            ("prior rows weighed", getattr(filter, "weigh_prior", False)),
            ("scaled by MAD", getattr(filter, "mad", False)),
            ("federated", getattr(filter, "federated", False)),
            (f"soft, temperature {checkpoint.temperature}", checkpoint.temperature is not None),
        )
        if present
    ]
    channels = [f"{name} ({_unit(filter, name)})" for name in filter.channels]
    parts = [
        f"Equations: {_rule(filter)}{'; ' if options else ''}{'; '.join(options)}.",
        f"States: {', '.join(filter.states)} (positions in m, velocities in m/s). Times are in s, "
        "angles in rad.",
        f"Channels, in order: {', '.join(channels)}.",
    ]
    return "\n".join(wrapped(comment(part), "     ", "   ") for part in parts)


def _rule(filter: Recipe) -> str:
    """How models are linearised; of a mixture, how each mode's are."""
    if isinstance(filter, Mixture):
        each = "; ".join(f"{name}: {_rule(mode)}" for name, mode in filter.modes.items())
        return f"interacting multiple models ({each})"
    return RULES[str(getattr(filter, "linearise", "taylor"))]


def _unit(filter: Recipe, channel: str) -> str:
    for sensor in filter.sensors:
        if channel in sensor.channels:
            return str(getattr(sensor, "unit", "its own unit"))
    raise AssertionError(channel)


def frozen_names(filter: Recipe, name: str) -> dict[str, list[str]]:
    """Constants of each parameter's entries, in row-major order, by parameter."""
    entries = {key: parameter.entries() for key, parameter in filter.declarations.items()}
    found = identifiers((entry for part in entries.values() for entry in part), OWN)
    return {key: [f"{name}_{found[e]}".upper() for e in part] for key, part in entries.items()}


def frozen_values(checkpoint: Checkpoint, name: str) -> list[str]:
    """A definition of each frozen value, with its meaning, unit and source."""
    filter, lines = checkpoint.published_filter, []
    constants = frozen_names(filter, name)
    for key, parameter in filter.declarations.items():
        unit = parameter.unit if parameter.unit != "1" else "no unit"
        said = [parameter.meaning, unit, "tuned" if parameter.tuned else parameter.source]
        lines.append(f"/* {comment(key)}: {comment('; '.join(word for word in said if word))} */")
        flat = checkpoint.values[key].reshape(-1).tolist()
        lines += [
            f"static const {name}_real {constant} = ({name}_real){value!r};"
            for constant, value in zip(constants[key], flat, strict=True)
        ]
    return lines


def array(
    kind: str, name: str, sizes: Sequence[object], value: Tensor, number: Callable[[float], str]
) -> str:
    """A constant of any shape, as C."""
    dimensions = "".join(f"[{size}]" for size in sizes)

    def braces(part: Tensor) -> str:
        if part.dim() == 0:
            return number(float(part))
        return "{" + ", ".join(braces(item) for item in part) + "}"

    return wrapped(f"static const {kind} {name}{dimensions} = {braces(value)};", "    ")


def wrapped(text: str, indent: str, first: str = "") -> str:
    """Lines of 100 columns at most where there are spaces."""
    return textwrap.fill(
        text, 100, initial_indent=first, subsequent_indent=indent,
        break_long_words=False, break_on_hyphens=False,
    )  # fmt: skip
