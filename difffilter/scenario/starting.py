"""``[start]`` of a scenario: where trajectories begin."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from difffilter.scenario.table import Table

__all__ = ["STARTS", "StartSpec", "read_start"]

STARTS = ("truth", "measurements", "bearings", "given")
GIVEN = ("position", "covariance", "time")


@dataclass(frozen=True)
class StartSpec:
    """How trajectories start.

    Attributes:
        kind: ``truth`` (of a simulation, plus normal errors; of a recorded log, as it is),
            ``measurements``, ``bearings`` (the first ones crossed), or ``given``.
        position_sigma, velocity_sigma: standard deviation of those errors, m and m/s; of a
            recorded log's truth, what the filter is told (``start.sigma`` where both are 0).
        rows, span: rows that a start from measurements reads, and seconds.
        unknown_velocity: m/s, standard deviation of the velocity in a start from
            measurements; None for the filter's own ``start.sigma``.
        velocity: m/s, of the target, where it is known (``bearings``), expected or given.
        sensors: those that make a start from measurements or bearings; None for all.
        position: m, given; covariance: of all states, its diagonal or its rows, None for
            ``start.sigma``; time: s, None for the first row's.
    """

    kind: str
    position_sigma: float = 0.0
    velocity_sigma: float = 0.0
    rows: int = 10
    unknown_velocity: float | None = None
    velocity: tuple[float, ...] | None = None
    span: float = 2.0
    sensors: tuple[str, ...] | None = None
    position: tuple[float, ...] | None = None
    covariance: tuple[float, ...] | tuple[tuple[float, ...], ...] | None = None
    time: float | None = None


def read_start(table: Table, simulated: bool, axes: int, sensors: Sequence[str]) -> StartSpec:
    """Validate ``[start]``.

    Args:
        simulated: whether there is a ``[world]``; axes: of the position; sensors: their names.

    Raises:
        InputError: names the key, what was found and what was expected.
    """
    usual = "truth" if simulated else "measurements"
    kind = table.text("kind", "given" if "position" in table else usual, choices=STARTS)
    if kind != "given":
        for key in GIVEN:
            if key in table:
                table.fail(key, "none beside a kind other than 'given'")
    spec = StartSpec(
        kind=kind,
        position_sigma=table.number("position_sigma", 0.0, low=0.0),
        velocity_sigma=table.number("velocity_sigma", 0.0, low=0.0),
        rows=table.integer("rows", 10, low=1),
        unknown_velocity=table.number("unknown_velocity", None, above=0.0),
        velocity=table.numbers("velocity", axes, None),
        span=table.number("span", 2.0, low=0.0),
        sensors=table.names("sensors", None),
        position=table.numbers("position", axes, None),
        covariance=_covariance(table),
        time=table.number("time", None),
    )
    if kind == "given" and spec.position is None:
        table.fail("position", f"{axes} numbers beside kind = 'given'")
    if kind == "bearings" and spec.velocity is None:
        table.fail("velocity", f"{axes} numbers beside kind = 'bearings'")
    if kind == "bearings" and spec.rows < 2:
        table.fail("rows", "2 or more beside kind = 'bearings'")
    if spec.sensors is not None and (not spec.sensors or set(spec.sensors) - set(sensors)):
        table.fail("sensors", f"one or more of {', '.join(sensors)}")
    table.finish()
    return spec


def _covariance(table: Table) -> tuple[float, ...] | tuple[tuple[float, ...], ...] | None:
    """n variances, or n rows of n numbers."""
    expected = "n variances, or n rows of n numbers"
    found = table.nested("covariance", None)
    if found is None:
        return None
    try:
        rows = tuple(found)
    except TypeError:
        table.fail("covariance", expected)
    if all(isinstance(x, float) for x in rows) and rows:
        if min(rows) < 0.0:
            table.fail("covariance", "variances of 0 or more")
        return rows
    if not rows or any(not isinstance(r, tuple) or len(r) != len(rows) for r in rows):
        table.fail("covariance", expected)
    return rows
