"""A robust start of a filter from the first measurements, never from the truth."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.gauss_newton import gauss_newton, residual
from difffilter.information import stacked_noise
from difffilter.log import Log, Start
from difffilter.parameters import Values
from difffilter.sensor import Sensor
from difffilter.sensors import Position
from difffilter.start_grid import candidates

__all__ = ["Recipe", "from_measurements"]

CHUNK = 128
REFINED = 8


class Recipe(Protocol):
    """What the start asks of a filter or another estimator."""

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states, the position first."""

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """The measurement models."""

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the sensors' channels."""

    def published(self, dtype: torch.dtype = torch.float64) -> dict[str, Tensor]:
        """Declared values."""

    def prepare(self, values: Values | None = None) -> Values:
        """Constants from values."""


class _Epochs(NamedTuple):
    """The first measured rows of each trajectory, (E, B, ...); NaN where there are fewer."""

    z: Tensor
    inputs: Mapping[str, Tensor]
    elapsed: Tensor  # (B,) mean time of the rows after the log's first, s


@torch.no_grad()
def from_measurements(
    recipe: Recipe,
    log: Log,
    values: Values | None = None,
    rows: int = 10,
    span: float = 2.0,
    scale: float = 3.0,
    velocity_sigma: float | None = None,
    iterations: int = 20,
) -> Start:
    """Start mean of every trajectory: position by robust least squares, all else zero.

    The position is taken as constant over the first ``rows`` rows with a measurement within
    ``span`` seconds of the first such row (further rows until enough channels were seen to
    determine it). Cost: the sum of log(1 + (e / (scale sigma))^2) over all channels and rows
    (Cauchy), so that wild values among the first rows do no harm. A coarse grid per sensor
    type (see :mod:`difffilter.start_grid`), the best candidates refined by
    :func:`difffilter.gauss_newton.gauss_newton`, the lowest cost kept: deterministic, not
    differentiable. Poor geometry can leave a mirror image of nearly equal cost.

    Args:
        recipe: the filter or estimator; its position is the first states.
        log: z (T, m) or (T, ..., m); rows may be missing, also at the end.
        values: parameter values (noise, stations); the declared ones if missing.
        rows: number of rows, 1 or more; fewer where the target moves fast.
        span: seconds.
        scale: of the Cauchy cost, in the sensors' sigmas.
        velocity_sigma: m/s; if given, the start has a covariance: that of the fit, plus the
            motion from the log's first row to the mean of the rows used, and this for the
            velocities. Without it, the covariance is None: the filter's ``start.sigma``.
        iterations: of the refinement.

    Returns:
        Mean (..., n) at the first row's time: the position, then zeros (velocities and
        whatever else the state holds).

    Raises:
        InputError: a trajectory, named, whose log never determines a position; channels that
            do not fit; a covariance for states other than position and velocity.
    """
    if log.channels != recipe.channels:
        raise InputError(
            f"log: found channels {', '.join(log.channels)}, expected {', '.join(recipe.channels)}"
        )
    if rows < 1:
        raise InputError(f"rows: found {rows}, expected 1 or more")
    constants = recipe.prepare(recipe.published(log.z.dtype) | dict(values or {}))
    n, axes = len(recipe.states), _axes(recipe)
    if velocity_sigma is not None and n not in (axes, 2 * axes):
        raise InputError(
            f"velocity_sigma: found states {', '.join(recipe.states)}, expected positions and "
            "their velocities"
        )
    flat = _flatten(log)
    needed = _needed(recipe, axes)
    positions, deviations, elapsed = [], [], []
    for first in range(0, flat.trajectories, CHUNK):
        part = flat.select(range(first, min(first + CHUNK, flat.trajectories)))
        epochs = _epochs(part, rows, span, needed)
        position, spread = _locate(recipe.sensors, constants, epochs, n, axes, scale, iterations)
        failed = torch.isnan(position).any(-1).nonzero().flatten().tolist()
        if failed:
            name = flat.names[first + failed[0]] if flat.names else ""
            raise InputError(
                f"start: trajectory {name or first + failed[0]}: its measurements never "
                "determine a position"
            )
        positions.append(position)
        deviations.append(spread)
        elapsed.append(epochs.elapsed)
    lead = log.z.shape[1:-1]
    mean = torch.nn.functional.pad(torch.cat(positions), (0, n - axes))
    covariance = None
    if velocity_sigma is not None:
        block = torch.cat(deviations)
        moved = (velocity_sigma * torch.cat(elapsed)).square()
        unit = torch.eye(axes, dtype=mean.dtype, device=mean.device)
        block = block @ block.mT + moved[:, None, None] * unit
        covariance = torch.diag_embed(torch.full_like(mean, velocity_sigma**2))
        covariance = torch.nn.functional.pad(block, (0, n - axes, 0, n - axes)) + torch.cat(
            [torch.zeros_like(covariance[:, :axes]), covariance[:, axes:]], dim=1
        )
        covariance = covariance.reshape(*lead, n, n)
    return Start(mean.reshape(*lead, n), covariance)


def _axes(recipe: Recipe) -> int:
    """Position components: as the built-in sensors say, else states before the velocities."""
    axes = [int(getattr(sensor, "axes", 0)) for sensor in recipe.sensors]
    if max(axes, default=0):
        return max(axes)
    states = recipe.states
    leading = [i for i, name in enumerate(states) if name.startswith("v")]
    return leading[0] if leading else len(states)


def _needed(recipe: Recipe, axes: int) -> int:
    """Channels that must have been seen: one more than axes unless a position is measured."""
    extra = 0 if any(isinstance(sensor, Position) for sensor in recipe.sensors) else 1
    return min(axes + extra, len(recipe.channels))


def _flatten(log: Log) -> Log:
    """The log with one dimension of trajectories."""
    lead = log.z.shape[1:-1]
    time = log.time.reshape(log.steps, -1)
    size = lead.numel()
    inputs = {
        name: value.reshape(log.steps, size, *value.shape[1 + len(lead) :])
        for name, value in log.inputs.items()
    }
    z = log.z.reshape(log.steps, size, -1)
    return Log(log.channels, time.expand(-1, size), z, inputs=inputs, names=log.names)


def _epochs(log: Log, rows: int, span: float, needed: int) -> _Epochs:
    """Each trajectory's first measured rows, gathered to a common length."""
    measured = log.measured
    rank = measured.cumsum(0)
    begin = measured.to(log.time.dtype).argmax(0, keepdim=True)
    since = log.time - log.time.gather(0, begin)
    seen = (log.present.cumsum(0) > 0).sum(-1)
    short = torch.cat([torch.zeros_like(seen[:1]), seen[:-1]]) < needed
    wanted = measured & (((rank <= rows) & (since <= span)) | short)
    length = max(int(wanted.sum(0).max()), 1)
    index = torch.argsort(wanted.to(torch.int8), dim=0, descending=True, stable=True)[:length]
    valid = wanted.gather(0, index)

    def gather(x: Tensor) -> Tensor:
        at = index.reshape(*index.shape, *[1] * (x.dim() - 2))
        return x.gather(0, at.expand(-1, -1, *x.shape[2:]))

    z = torch.where(valid.unsqueeze(-1), gather(log.z), torch.nan)
    time = torch.where(valid, gather(log.time), torch.nan)
    elapsed = torch.nan_to_num(time.nanmean(0) - log.time[0])
    return _Epochs(z, {name: gather(value) for name, value in log.inputs.items()}, elapsed)


def _locate(
    sensors: tuple[Sensor, ...],
    constants: Values,
    epochs: _Epochs,
    states: int,
    axes: int,
    scale: float,
    iterations: int,
) -> tuple[Tensor, Tensor]:
    """Position (B, axes) of lowest Cauchy cost and its deviations; NaN where undetermined."""
    sigma = stacked_noise(sensors, constants).total.sqrt()
    z = epochs.z.unsqueeze(1)
    inputs = {name: value.unsqueeze(1) for name, value in epochs.inputs.items()}

    def cost(position: Tensor) -> Tensor:
        """(C, B, axes) -> (C, B)."""
        state = torch.nn.functional.pad(position, (0, states - axes))
        predicted = [sensor.predict(state, inputs, constants) for sensor in sensors]
        s = residual(sensors, z, predicted) / (scale * sigma)
        total = torch.log1p(s.square()).sum((0, -1))
        return torch.where(torch.isnan(total), torch.inf, total)

    def best(position: Tensor, value: Tensor, count: int) -> Tensor:
        """The ``count`` candidates (count, B, axes) of lowest cost."""
        index = value.topk(min(count, len(value)), dim=0, largest=False, sorted=True).indices
        return position.gather(0, index.unsqueeze(-1).expand(-1, -1, axes))

    found = []
    for grid in candidates(sensors, constants, epochs.z, epochs.inputs, axes):
        value = cost(grid.flatten(0, 1)).reshape(grid.shape[:3])
        least, member = value.min(1)
        index = member[:, None, :, None].expand(-1, 1, -1, axes)
        found.append(best(grid.gather(1, index).squeeze(1), least, REFINED))
    start = torch.cat(found)
    fix = gauss_newton(
        sensors,
        constants,
        z,
        inputs,
        start,
        lambda s: 1.0 / (1.0 + (s / scale).square()),
        iterations,
        epochs=True,
        states=states,
    )
    # A candidate without a fix costs infinity; where all have none, the result stays NaN.
    order = cost(fix.position).argmin(0)
    pick = order[None, :, None]
    position = fix.position.gather(0, pick.expand(1, -1, axes))[0]
    spread = fix.deviations.gather(0, pick.unsqueeze(-1).expand(1, -1, axes, axes))[0]
    return position, spread
