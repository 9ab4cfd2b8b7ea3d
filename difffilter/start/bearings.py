"""Crossing bearings: a start from the first ones, and the least squares that both share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.logs.log import Log, Start
from difffilter.parameters.parameters import Values
from difffilter.parameters.values import Constants
from difffilter.sensors.bearing import Bearing
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.wrapped import bare
from difffilter.start.parts import Startable, part_of
from difffilter.start.rows import flatten

__all__ = ["Lines", "crossing", "from_bearings", "lines", "the_bearing"]

#: Least determinant of the normal matrix, relative to its squared trace, at which lines cross
#: (or some roundings of the precision, if that is more).
PARALLEL = 1e-10


class Lines(NamedTuple):
    """Lines of position for a target of known velocity, moved back to one time.

    With the unit normal a = (sin b, -cos b) of a bearing b taken at s, the target's position p
    at that time satisfies a p = a (s - v tau): the pseudo-linear equation.

    Attributes:
        bearing: (T, B, m), bias taken off, NaN where missing.
        origin: (T, B, m, 2), s - v tau.
        normal: (T, B, m, 2), 0 where missing.
        present: (T, B, m).
    """

    bearing: Tensor
    origin: Tensor
    normal: Tensor
    present: Tensor


def the_bearing(sensors: Sequence[Sensor]) -> Bearing:
    """The one bearing sensor; InputError if there are others beside it."""
    if len(sensors) == 1 and isinstance(bare(sensors[0]), Bearing):
        found: Bearing = bare(sensors[0])
        return found
    names = ", ".join(type(bare(sensor)).__name__ for sensor in sensors)
    raise InputError(f"sensors: found {names}, expected one bearing sensor alone")


def lines(
    sensor: Bearing, log: Log, constants: Constants, velocity: Tensor, since: Tensor
) -> Lines:
    """Lines of position of every bearing.

    Args:
        log: z (T, B, m); velocity: (2,), m/s; since: (T, B), tau, s.
    """
    z = log.z - constants[f"{sensor.name}.bias"]
    present = ~torch.isnan(z)
    stations = sensor.located(log.inputs, constants).expand(*z.shape, 2)
    origin = stations - (since.unsqueeze(-1) * velocity).unsqueeze(-2)
    known = torch.nan_to_num(z)
    normal = torch.stack([known.sin(), -known.cos()], dim=-1) * present.unsqueeze(-1)
    return Lines(z, origin, normal, present)


def crossing(normal: Tensor, right: Tensor) -> Tensor:
    """Solution of the normal equations N p = y, NaN where the lines do not cross.

    Args:
        normal: (..., 2, 2); right: (..., 2).
    """
    a, b, d = normal[..., 0, 0], normal[..., 0, 1], normal[..., 1, 1]
    determinant = a * d - b.square()
    least = max(PARALLEL, 16 * torch.finfo(normal.dtype).eps)
    crosses = determinant > least * (a + d).square()
    divisor = torch.where(crosses, determinant, torch.nan)
    first = d * right[..., 0] - b * right[..., 1]
    second = a * right[..., 1] - b * right[..., 0]
    return torch.stack([first, second], dim=-1) / divisor.unsqueeze(-1)


@torch.no_grad()
def from_bearings(
    recipe: Startable,
    log: Log,
    velocity: Sequence[float],
    values: Values | None = None,
    rows: int = 6,
    lead: float = 0.0,
    *,
    sensors: Sequence[str] | None = None,
) -> Start:
    """Start of every trajectory from its first bearings: pseudo-linear least squares (paper 1).

    Minimises the sum of (a_k (p + v tau_k - s_k))^2 over the bearings of the first ``rows``
    rows that have one, for a target of known velocity v. The state holds p and v at ``lead``
    seconds before the first row; its covariance is the filter's ``start.sigma``.

    Args:
        recipe: with one bearing sensor; states are the position, then the velocity.
        log: z (T, m) or (T, ..., m).
        velocity: m/s, of the target in the frame of the state (relative to the observer where
            the state is).
        values: parameter values (bias); the declared ones if missing.
        rows: 2 or more.
        lead: s.
        sensors: the name of the one that makes the start, where there are others.

    Raises:
        InputError: another sensor; a trajectory, named, whose first bearings do not cross,
            cross behind the observer, or cross so flatly that their noise leaves the distance
            open (3 standard deviations reach the observer).
    """
    part = part_of(recipe, sensors)
    sensor = the_bearing(part.sensors)
    log = log.only(part.channels)
    if rows < 2:
        raise InputError(f"rows: found {rows}, expected 2 or more")
    constants = recipe.prepare(recipe.published(log.z.dtype) | dict(values or {}))
    flat = flatten(log)
    moving = flat.z.new_tensor(list(velocity))
    since = flat.time - flat.time[:1] + lead
    wanted = flat.measured & (flat.measured.cumsum(0) <= rows)
    chosen = torch.where(wanted.unsqueeze(-1), flat.z, torch.nan)
    first = Log(flat.channels, flat.time, chosen, inputs=flat.inputs, names=flat.names)
    found = lines(sensor, first, constants, moving, since)
    position = _crossing_of(found)
    mean = torch.cat([position, moving.expand_as(position)], dim=-1)
    mean = mean[:, : len(recipe.bare_states)]
    _check(
        found, position, part.sensors[0].noise(mean, flat.inputs, constants).total, flat.names, rows
    )
    mean = mean.reshape(*log.z.shape[1:-1], -1)
    if not lead:
        return Start(mean)
    time = log.time[0]
    if time.dim() and bool((time != time[:1]).any()):
        raise InputError("start: found logs that begin at different times, expected one time")
    return Start(mean, None, float(time.reshape(-1)[0]) - lead)


def _crossing_of(found: Lines) -> Tensor:
    """(B, 2), where all lines cross best; NaN where they do not."""
    outer = found.normal.unsqueeze(-1) * found.normal.unsqueeze(-2)
    right = found.normal * (found.normal * found.origin).sum(-1, keepdim=True)
    return crossing(outer.sum((0, 2)), right.sum((0, 2)))


def _check(
    found: Lines, position: Tensor, noise: Tensor, names: Sequence[str | None], rows: int
) -> None:
    """InputError that names the first trajectory whose bearings do not determine a position."""
    for bad, what in (
        (torch.isnan(position).any(-1), "do not cross"),
        (_behind(found, position), "cross behind the observer"),
        (_open(found, position, noise), "leave its distance open, expected more rows"),
    ):
        if bool(bad.any()):
            at = int(bad.nonzero()[0])
            name = names[at] if names and names[at] else at
            raise InputError(f"start: trajectory {name}: its first {rows} bearings {what}")


def _behind(found: Lines, position: Tensor) -> Tensor:
    """(B,), whether most of the bearings point away from the position."""
    ahead = found.bearing.cos() * (position[:, None] - found.origin)[..., 0]
    ahead = ahead + found.bearing.sin() * (position[:, None] - found.origin)[..., 1]
    return torch.where(found.present, ahead, 0.0).sum((0, 2)) <= 0.0


def _open(found: Lines, position: Tensor, noise: Tensor) -> Tensor:
    """(B,), whether 3 standard deviations of the position reach the nearest observer.

    Args:
        position: (B, 2); noise: variance of the bearings, broadcasting with (T, B, m).
    """
    apart = (position[:, None] - found.origin).square().sum(-1)
    inverse = torch.where(found.present, (noise * apart).reciprocal(), 0.0)
    outer = found.normal.unsqueeze(-1) * found.normal.unsqueeze(-2)
    information = (inverse[..., None, None] * outer).sum((0, 2))
    least = torch.linalg.eigvalsh(torch.nan_to_num(information))[..., 0]
    nearest = torch.where(found.present, apart, torch.inf).amin((0, 2))
    reached: Tensor = least * nearest < 9.0
    return reached
