"""What the states of a model are: positions, velocities, angles, or something else."""

from __future__ import annotations

from collections.abc import Iterable

__all__ = ["AXES", "KINDS", "UNITS", "kinds_by_name"]

AXES = ("x", "y", "z")
#: What a state can be; an ``angle`` is in rad and its residual wraps.
KINDS = ("position", "velocity", "angle", "other")
#: Unit of a state of each kind; ``other`` has its own.
UNITS = {"position": "m", "velocity": "m/s", "angle": "rad", "other": ""}


def kinds_by_name(states: Iterable[str]) -> dict[str, str]:
    """x, y, z are positions, vx, vy, vz velocities, all else is other."""
    kinds = dict.fromkeys(AXES, "position") | {f"v{axis}": "velocity" for axis in AXES}
    return {name: kinds.get(name, "other") for name in states}
