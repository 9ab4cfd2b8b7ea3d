"""``[start]`` of a scenario: how trajectories start."""

from __future__ import annotations

from dataclasses import dataclass

from difffilter.scenario.table import Table

__all__ = ["STARTS", "StartSpec", "read_start"]

STARTS = ("truth", "measurements", "bearings")


@dataclass(frozen=True)
class StartSpec:
    """How trajectories start.

    Attributes:
        kind: ``truth`` (simulation only: truth plus normal errors), ``measurements``, or
            ``bearings`` (the first ones crossed).
        position_sigma, velocity_sigma: standard deviation of those errors, m and m/s.
        rows: rows that a start from measurements reads.
        unknown_velocity: m/s, standard deviation of the velocity in a start from
            measurements; None for the filter's own ``start.sigma``.
        velocity: m/s, of the target, where it is known (``bearings``).
    """

    kind: str
    position_sigma: float
    velocity_sigma: float
    rows: int
    unknown_velocity: float | None
    velocity: tuple[float, ...] | None = None


def read_start(table: Table, simulated: bool, axes: int) -> StartSpec:
    kind = table.text("kind", "truth" if simulated else "measurements", choices=STARTS)
    if kind == "truth" and not simulated:
        table.fail("kind", "'measurements' or 'bearings' in a scenario without [world]")
    spec = StartSpec(
        kind=kind,
        position_sigma=table.number("position_sigma", 0.0, low=0.0),
        velocity_sigma=table.number("velocity_sigma", 0.0, low=0.0),
        rows=table.integer("rows", 10, low=1),
        unknown_velocity=table.number("unknown_velocity", None, above=0.0),
        velocity=table.numbers("velocity", axes, None),
    )
    if kind == "bearings" and spec.velocity is None:
        table.fail("velocity", f"{axes} numbers beside kind = 'bearings'")
    if kind == "bearings" and spec.rows < 2:
        table.fail("rows", "2 or more beside kind = 'bearings'")
    table.finish()
    return spec
