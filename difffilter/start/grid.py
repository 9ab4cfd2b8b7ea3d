"""Where a position might be: coarse candidates from the measurements of each sensor.

Candidates are (groups, members, B, axes), m, for B trajectories: only the best member of
each group is refined, so that candidates far apart survive.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.parameters.values import Constants
from difffilter.sensors.builtin import TDOA, Bearing, Position, Range, StationSensor
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.wrapped import bare

__all__ = ["candidates"]

ANGLES = 72
SECTORS = 12
#: Numbers of points along each axis of the grid over the stations' box, by axes; and of
#: blocks along each axis.
BOX_POINTS = {1: 600, 2: 25, 3: 8}
BOX_BLOCKS = {1: 25, 2: 5, 3: 2}
#: Distances from the origin, m, where a sensor tells nothing about its stations.
FALLBACK_RADII = tuple(10.0 ** (0.25 * i) for i in range(21))


def candidates(
    sensors: Sequence[Sensor],
    constants: Constants,
    z: Tensor,
    inputs: Mapping[str, Tensor],
    axes: int,
) -> list[Tensor]:
    """Candidate positions of each sensor, a list of (groups, members, B, axes).

    Args:
        sensors, constants: models and their constants.
        z: (E, B, m), NaN where missing; inputs: (E, B, ...).
        axes: components of the position.

    Raises:
        InputError: more axes than 3.
    """
    if axes not in BOX_POINTS:
        raise InputError(f"start: found a position of {axes} axes, expected 1 to 3")
    found, unknown, at = [], False, 0
    for sensor in sensors:
        here = z[..., at : at + len(sensor.channels)]
        at += len(sensor.channels)
        sensor = bare(sensor)
        if isinstance(sensor, Position):
            bias = constants[f"{sensor.name}.bias"]
            median = (here - bias).nanmedian(dim=0).values
            found.append(torch.where(torch.isnan(median), 0.0, median)[None, None])
        elif isinstance(sensor, TDOA):
            found.append(_box(_stations(sensor, constants, inputs, z)[..., :axes]))
        elif isinstance(sensor, Range):
            stations = _stations(sensor, constants, inputs, z)[..., :axes]
            found.append(_rings(stations, here - constants[f"{sensor.name}.bias"]))
        elif isinstance(sensor, Bearing):
            stations = _stations(sensor, constants, inputs, z)
            found.append(_rays(stations, here - constants[f"{sensor.name}.bias"]))
        else:
            unknown = True
    if unknown and not found:
        radii = z.new_tensor(FALLBACK_RADII)[:, None].expand(-1, z.shape[1])
        found.append(_around(z.new_zeros(z.shape[1], axes), radii))
    return found


def _stations(
    sensor: StationSensor, constants: Constants, inputs: Mapping[str, Tensor], z: Tensor
) -> Tensor:
    """(B, stations, coordinates) at the first epoch."""
    first = {name: value[0] for name, value in inputs.items()}
    stations = sensor.located(first, constants)
    return stations.expand(z.shape[1], *stations.shape[-2:])


def _rings(stations: Tensor, ranges: Tensor) -> Tensor:
    """Rings about the stations' centroid, at radii that bracket the ranges: no mirror is lost.

    Radii are 0.9, 1 and 1.1 times the median range, and its 20th and 80th percentile.
    """
    every = ranges.movedim(1, 0).flatten(1)
    middle = every.nanmedian(dim=-1).values
    spread = every.nanquantile(every.new_tensor([0.2, 0.8]), dim=-1)
    radii = torch.cat([torch.stack([0.9 * middle, middle, 1.1 * middle]), spread])
    return _around(stations.mean(-2), torch.where(torch.isnan(radii), 1.0, radii))


def _rays(stations: Tensor, bearings: Tensor) -> Tensor:
    """Points along each station's first bearing (E, B, m), at any distance."""
    first = (~torch.isnan(bearings)).to(torch.int8).argmax(0, keepdim=True)
    bearing = torch.nan_to_num(bearings.gather(0, first)[0])
    direction = torch.stack([bearing.cos(), bearing.sin()], dim=-1)
    radii = bearings.new_tensor(FALLBACK_RADII)[:, None, None, None]
    return (stations + radii * direction).movedim(2, 1)


def _around(centre: Tensor, radii: Tensor) -> Tensor:
    """Points at radii (R, B) about a centre (B, axes), grouped by direction."""
    directions, groups = _directions(centre)
    points = centre + directions[:, None, None] * radii[..., None]
    return points.reshape(groups, -1, *centre.shape)


def _directions(like: Tensor) -> tuple[Tensor, int]:
    """Unit vectors (D, axes) in an order where neighbours are near, and how many groups."""
    axes = like.shape[-1]
    if axes == 1:
        return like.new_tensor([[-1.0], [1.0]]), 2
    turn = torch.arange(ANGLES, dtype=like.dtype, device=like.device) * (2 * math.pi / ANGLES)
    circle = torch.stack([turn.cos(), turn.sin()], dim=-1)
    if axes == 2:
        return circle, SECTORS
    # Latitudes of equal area; every third angle of the circle suffices at each.
    height = (torch.arange(8, dtype=like.dtype, device=like.device) - 3.5) / 4.0
    flat = (1.0 - height.square()).sqrt()[:, None, None] * circle[::3]
    up = height[:, None, None].expand(*flat.shape[:-1], 1)
    return torch.cat([flat, up], dim=-1).reshape(-1, 3), 2 * 8


def _box(stations: Tensor) -> Tensor:
    """Grid over the stations' bounding box (B, stations, axes), half its size more each way."""
    axes = stations.shape[-1]
    points, blocks = BOX_POINTS[axes], BOX_BLOCKS[axes]
    low, high = stations.amin(-2), stations.amax(-2)
    size = (high - low).clamp_min(1e-3 * (high - low).amax(-1, keepdim=True))
    line = (torch.arange(points, dtype=low.dtype, device=low.device) + 0.5) / points
    block = torch.arange(points, device=low.device) // (points // blocks)
    unit = torch.cartesian_prod(*[line] * axes).reshape(-1, axes)
    label = torch.cartesian_prod(*[block] * axes).reshape(-1, axes)
    weights = label.new_tensor([blocks**i for i in range(axes)])
    unit = unit[torch.argsort((label * weights).sum(-1), stable=True)]
    grid = low - 0.5 * size + 2.0 * size * unit[:, None]
    return grid.reshape(blocks**axes, -1, *low.shape)
