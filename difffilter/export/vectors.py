"""What fills the golden vectors and the self-test of an exported filter."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from difffilter.export.golden import Golden
from difffilter.export.program import identifiers
from difffilter.export.words import array

__all__ = ["test", "vectors"]


def vectors(made: Golden, known: Sequence[str], name: str) -> dict[str, str]:
    """What fills the golden vectors."""
    log = made.log
    inputs = "\n".join(
        numbers(f"{name}_golden_input_{field}", ("ROWS",), log.inputs[key].reshape(-1))
        for key, field in identifiers(known).items()
    )
    prefix = f"{name}_golden_"
    return {
        "rows": str(log.steps),
        "double": f"{made.tolerance[0]:.1e}",
        "single": f"{made.tolerance[1]:.1e}",
        "arrays": "\n".join(
            [
                numbers(prefix + "dt", ("ROWS",), made.dt),
                numbers(prefix + "z", ("ROWS", "M"), log.z.nan_to_num(0.0)),
                numbers(prefix + "present", ("ROWS", "M"), log.present.to(torch.float64)),
                numbers(prefix + "mean", ("N",), made.mean),
                numbers(prefix + "deviations", ("P", "P"), made.deviations),
                numbers(prefix + "means", ("ROWS", "N"), made.means),
                numbers(prefix + "covariances", ("ROWS", "P", "P"), made.covariances),
                numbers(prefix + "spread", ("ROWS", "P"), made.spread),
                numbers(prefix + "size", ("ROWS", "N"), made.size),
                *(
                    numbers(prefix + key, ("ROWS", "M"), value)
                    for key, value in made.results.items()
                ),
                *([inputs] if inputs else []),
            ]
        ),
    }


def test(known: Sequence[str], name: str) -> dict[str, str]:
    """What fills the self-test."""
    lines = [
        f"        inputs.{field} = ({name}_real){name}_golden_input_{field}[k];"
        for field in identifiers(known).values()
    ]
    return {
        "declare": f"    {name}_inputs inputs;\n" if known else "",
        "fill": "\n".join(lines) + "\n" if lines else "",
        "pass": ", &inputs" if known else "",
    }


def numbers(name: str, sizes: Sequence[str], value: Tensor) -> str:
    """An array of doubles."""
    return array("double", name, sizes, value, repr)
