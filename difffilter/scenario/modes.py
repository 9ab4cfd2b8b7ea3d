"""The modes of a system that is several filters at once: ``[systems.NAME.modes.MODE]``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from difffilter.parameters.parameters import Number, as_number
from difffilter.scenario.options import OPTIONS
from difffilter.scenario.table import Table

__all__ = ["ModeSpec", "read_modes"]

#: Options that belong to the system, not to a mode of it.
WHOLE = ("fusion", "clairvoyant")


@dataclass(frozen=True)
class ModeSpec:
    """One mode, as read.

    Attributes:
        motion: of its own, or None for the scenario's.
        options: of its filter, by key.
        values: published values of its own, by parameter.
    """

    name: str
    motion: Any
    options: Mapping[str, Any]
    values: Mapping[str, Number]

    def as_dict(self) -> dict[str, Any]:
        """As a checkpoint lists it."""
        motion = None if self.motion is None else self.motion.as_dict()
        return {"motion": motion, **self.options, "values": self.values}


def read_modes(table: Table, read_motion: Callable[[Table], Any]) -> tuple[ModeSpec, ...]:
    """Read ``[systems.NAME.modes]``; none where there is no such table."""
    found = []
    for name, mode in table.named():
        for key in WHOLE:
            if key in mode:
                mode.fail(key, "no such key in a mode")
        values = mode.table("values", optional=True)
        found.append(
            ModeSpec(
                name=name,
                motion=read_motion(mode.table("motion")) if "motion" in mode else None,
                options={key: option.read(mode, key) for key, option in OPTIONS.items()},
                values={key: as_number(values.nested(key)) for key in values.data},
            )
        )
        mode.finish()
    return tuple(found)
