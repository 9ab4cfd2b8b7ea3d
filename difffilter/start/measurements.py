"""A robust start of a filter from the first measurements, never from the truth."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.logs.log import Log, Start
from difffilter.parameters.parameters import Values
from difffilter.sensors.builtin import Position
from difffilter.sensors.information import stacked_noise
from difffilter.sensors.sensor import Sensor
from difffilter.start.fit import Weigh, gauss_newton, residual
from difffilter.start.grid import candidates
from difffilter.start.rows import Epochs, first_rows, flatten

__all__ = ["Recipe", "from_measurements"]

CHUNK = 128
REFINED = 8  # candidates per sensor
FINISHED = 4


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


@torch.no_grad()
def from_measurements(
    recipe: Recipe,
    log: Log,
    values: Values | None = None,
    rows: int = 10,
    span: float = 2.0,
    scale: float = 3.0,
    velocity_sigma: float | None = None,
    iterations: int = 10,
) -> Start:
    """Start mean of every trajectory: position by robust least squares, all else zero.

    The position is taken as constant over the first ``rows`` rows with a measurement within
    ``span`` seconds of the first such row (further rows until enough channels were seen to
    determine it). Cost: the sum of log(1 + (e / (scale sigma))^2) over all channels and rows
    (Cauchy), so that wild values among the first rows do no harm. A coarse grid per sensor
    type (see :mod:`difffilter.start.grid`), the best candidates refined by
    :func:`difffilter.start.fit.gauss_newton`, the lowest cost kept: deterministic, not
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
        iterations: of the first refinement; the best are refined twice as long.

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
    flat = flatten(log)
    needed = _needed(recipe, axes)
    positions, deviations, elapsed = [], [], []
    for first in range(0, flat.trajectories, CHUNK):
        part = flat.select(range(first, min(first + CHUNK, flat.trajectories)))
        epochs = first_rows(part, rows, span, needed)
        position, spread = _locate(recipe.sensors, constants, epochs, n, axes, scale, iterations)
        failed = torch.isnan(position).any(-1).nonzero().flatten().tolist()
        if failed:
            at = first + failed[0]
            name = flat.names[at] if flat.names and flat.names[at] else at
            raise InputError(
                f"start: trajectory {name}: its measurements never determine a position"
            )
        positions.append(position)
        deviations.append(spread)
        elapsed.append(epochs.elapsed)
    lead = log.z.shape[1:-1]
    mean = torch.nn.functional.pad(torch.cat(positions), (0, n - axes))
    covariance = None
    if velocity_sigma is not None:
        covariance = _covariance(torch.cat(deviations), torch.cat(elapsed), velocity_sigma, n)
        covariance = covariance.reshape(*lead, n, n)
    return Start(mean.reshape(*lead, n), covariance)


def _covariance(deviations: Tensor, elapsed: Tensor, sigma: float, states: int) -> Tensor:
    """The fit's covariance plus the motion within ``elapsed``, and sigma^2 for velocities."""
    axes = deviations.shape[-1]
    moved = (sigma * elapsed).square().unsqueeze(-1).expand(-1, axes)
    velocity = moved.new_full((len(moved), states - axes), sigma**2)
    fit = torch.nn.functional.pad(deviations, (0, 0, 0, states - axes))
    return fit @ fit.mT + torch.diag_embed(torch.cat([moved, velocity], dim=-1))


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


def _locate(
    sensors: tuple[Sensor, ...],
    constants: Values,
    epochs: Epochs,
    states: int,
    axes: int,
    scale: float,
    iterations: int,
) -> tuple[Tensor, Tensor]:
    """Position (B, axes) of lowest Cauchy cost and its deviations; NaN where undetermined."""
    z = epochs.z.unsqueeze(1)
    inputs = {name: value.unsqueeze(1) for name, value in epochs.inputs.items()}

    def cost(position: Tensor) -> Tensor:
        """(C, B, axes) -> (C, B)."""
        state = torch.nn.functional.pad(position, (0, states - axes))
        predicted = [sensor.predict(state, inputs, constants) for sensor in sensors]
        sigma = stacked_noise(sensors, state, inputs, constants).total.sqrt()
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
    present = ~torch.isnan(z)

    def wide(s: Tensor) -> Tensor:
        """Weights at the candidate's own scale: far from the minimum, longer steps."""
        size = torch.where(present, s.abs(), torch.nan).movedim(0, -1).flatten(-2)
        own = size.nanmedian(-1).values.nan_to_num(0.0).unsqueeze(-1)
        return 1.0 / (1.0 + (s / own.clamp_min(scale)).square())

    def narrow(s: Tensor) -> Tensor:
        return 1.0 / (1.0 + (s / scale).square())

    def refine(position: Tensor, weigh: Weigh, iterations: int) -> tuple[Tensor, Tensor, Tensor]:
        """Refined candidates, their deviations and costs; without a fix, infinity."""
        fix = gauss_newton(
            sensors, constants, z, inputs, position, weigh, iterations, epochs=True, states=states
        )
        return *fix, cost(fix.position)

    position, _, value = refine(torch.cat(found), wide, iterations)
    position, deviations, value = refine(best(position, value, FINISHED), narrow, 2 * iterations)
    pick = value.argmin(0)[None, :, None]
    spread = deviations.gather(0, pick.unsqueeze(-1).expand(1, -1, axes, axes))
    return position.gather(0, pick.expand(1, -1, axes))[0], spread[0]
