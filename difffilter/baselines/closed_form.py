"""Chan's two-step closed form for range differences."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.baselines.least_squares import Snapshot
from difffilter.core.linalg import positive_sqrt
from difffilter.errors import InputError
from difffilter.logs.log import Log, Start
from difffilter.parameters.parameters import Values
from difffilter.parameters.values import Constants
from difffilter.sensors.builtin import TDOA
from difffilter.sensors.information import Information, covariance_factor
from difffilter.sensors.sensor import Sensor
from difffilter.start.fit import Fix

__all__ = ["ChanLeastSquares", "chan", "range_differences", "the_tdoa"]


def chan(
    z: Tensor, stations: Tensor, information: Tensor, iterations: int = 2, tangent: bool = False
) -> Fix:
    """Position from range differences, without a start, over any leading dimensions.

    Step 1, relative to station 1: stations s_i, d_i = r_i - r_1, u = (position, r_1)::

        (d_i^2 - |s_i|^2) / 2 = -(s_i, d_i) u,   error covariance B R B, B = diag(r_i)

    with B = I at first, then ``iterations`` times from the last u. C = cov(u).
    Step 2, Chan's regression of (x^2, y^2, r_1^2) on (X^2, Y^2), each row divided by twice
    (x, y, r_1), so that it is well conditioned where x or y is small: with
    X^2 = x^2 + 2 x dx::

        [0; (r_1^2 - |p|^2) / (2 r_1)] = [I; p^T / r_1] dp + e,   cov(e) = C

    X = sign(x) sqrt(max(x^2 + 2 x dx, 0)), the sign from step 1; with ``tangent``
    X = x + dx. Source: Chan and Ho 1994, the baseline of paper 3; the division of the rows
    [reconstruction].

    Args:
        z: (..., m) range differences to the first station, m; NaN where missing.
        stations: (..., m + 1, axes), m, the reference first.
        information: (..., m, m), R^-1 of the present channels, 0 in the rows of missing ones.
        iterations: recomputations of B.

    Returns:
        The position and the deviations of dp; NaN where fewer than axes + 1 differences are
        present or the stations do not span the space (in a line, for example).
    """
    present = ~torch.isnan(z)
    d = torch.where(present, z, 0.0)
    axes = stations.shape[-1]
    enough = present.sum(-1) > axes
    reference = stations[..., 0, :]
    apart = stations[..., 1:, :] - stations[..., :1, :]
    lead = torch.broadcast_shapes(d.shape[:-1], apart.shape[:-2])  # type: ignore[no-untyped-call]
    apart, d = apart.expand(*lead, *apart.shape[-2:]), d.expand(*lead, -1)
    u, normal, known = _first_step(d, apart, information, enough, iterations)
    p = u[..., :axes]
    shift, deviations, also_known = _second_step(u, normal)
    known = known & also_known
    if tangent:
        solution = p + shift
    else:
        solution = p.sign() * positive_sqrt((p.square() + 2.0 * p * shift).clamp_min(0.0))
    return Fix(
        torch.where(known.unsqueeze(-1), solution + reference, torch.nan),
        torch.where(known[..., None, None], deviations, torch.nan),
    )


def _first_step(
    d: Tensor, apart: Tensor, information: Tensor, enough: Tensor, iterations: int
) -> tuple[Tensor, Tensor, Tensor]:
    """u = (position, r_1) relative to station 1, its information, and whether it is known."""
    axes = apart.shape[-1]
    design = -torch.cat([apart, d.unsqueeze(-1)], dim=-1)
    target = (0.5 * (d.square() - apart.square().sum(-1))).unsqueeze(-1)
    weighted = information @ design
    for iteration in range(iterations + 1):
        normal = design.mT @ weighted
        factor, regular = covariance_factor(normal)
        known = regular & enough
        u = (factor @ (factor.mT @ (weighted.mT @ target))).squeeze(-1)
        u = torch.where(known.unsqueeze(-1), u, 1.0)  # a finite gradient without a fix
        if iteration < iterations:
            distance = torch.linalg.vector_norm(u[..., None, :axes] - apart, dim=-1)
            inverse = _away_from_zero(distance).reciprocal().unsqueeze(-1)
            weighted = inverse * (information @ (inverse * design))
    return u, normal, known


def _second_step(u: Tensor, normal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Shift dp of the position, its deviations, and whether they are known."""
    axes = u.shape[-1] - 1
    p, r1 = u[..., :axes], u[..., axes:]
    size = _away_from_zero(torch.cat([r1.abs(), p.abs()], dim=-1))[..., :1]
    r1 = torch.where(r1 < 0, -size, size)
    mismatch = ((r1.square() - p.square().sum(-1, keepdim=True)) / (2.0 * r1)).unsqueeze(-1)
    unit = torch.eye(axes, dtype=p.dtype, device=p.device).expand(*u.shape[:-1], axes, axes)
    second = torch.cat([unit, (p / r1).unsqueeze(-2)], dim=-2)
    weighted = normal @ second
    deviations, regular = covariance_factor(second.mT @ weighted)
    right = weighted[..., axes:, :].mT @ mismatch  # the mismatch's other entries are zero
    return (deviations @ (deviations.mT @ right)).squeeze(-1), deviations, regular


def _away_from_zero(distance: Tensor) -> Tensor:
    """Distances (..., m) >= 0 kept away from 0, relative to the largest: a station passed over."""
    smallest = torch.finfo(distance.dtype).eps ** 0.5 * distance.amax(-1, keepdim=True)
    tiny = torch.finfo(distance.dtype).tiny
    return torch.maximum(distance, smallest).clamp_min(tiny)


@dataclass(frozen=True)
class ChanLeastSquares(Snapshot):
    """Chan's closed form per row; needs no start.

    Attributes:
        sensors: one TDOA sensor, its stations without heights.
        iterations, tangent: as in :func:`chan`.

    A log's input ``NAME.stations`` overrides the stations.
    """

    iterations: int = 2
    tangent: bool = False

    def __post_init__(self) -> None:
        the_tdoa(self.sensors, self.axes)

    def fix(
        self, log: Log, constants: Constants, values: Values | None, start: Start | None
    ) -> Fix:
        sensor = the_tdoa(self.sensors, self.axes)
        origin = torch.zeros(self.axes, dtype=log.z.dtype)  # its noise depends on no state
        noise = sensor.noise(origin, log.inputs, constants)
        information = Information(noise.independent, noise.common, log.present)
        z, stations = range_differences(sensor, log, constants)
        return chan(z, stations, information.matrix, self.iterations, self.tangent)


def the_tdoa(sensors: tuple[Sensor, ...], axes: int) -> TDOA:
    """The one TDOA sensor that Chan's closed form takes; InputError for anything else."""
    if len(sensors) != 1 or not isinstance(sensors[0], TDOA):
        raise InputError("sensors: expected one TDOA sensor for Chan's closed form")
    sensor = sensors[0]
    if sensor.axes != axes or len(sensor.stations[0]) != axes:
        raise InputError(
            f"{sensor.name}.stations: found {len(sensor.stations[0])} coordinates, expected "
            f"{axes}, without heights, for Chan's closed form"
        )
    if len(sensor.stations) < axes + 2:
        raise InputError(
            f"{sensor.name}.stations: found {len(sensor.stations)}, expected {axes + 2} or more "
            "for Chan's closed form"
        )
    return sensor


def range_differences(sensor: TDOA, log: Log, constants: Constants) -> tuple[Tensor, Tensor]:
    """Range differences (T, ..., m) without bias, and stations (..., m + 1, axes)."""
    key = f"{sensor.name}.stations"
    stations = log.inputs[key] if key in log.inputs else constants[key]
    return log.z - constants[f"{sensor.name}.bias"], stations
