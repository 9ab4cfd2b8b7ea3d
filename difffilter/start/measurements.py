"""A robust start of a filter from the first measurements, never from the truth.

Cost: the sum of log(1 + |e / (scale sigma)|^2) over rows and channels, those of a position fix
together (Cauchy), so that wild values do no harm. A coarse grid per sensor type (see
:mod:`difffilter.start.grid`), the best candidates refined by
:func:`difffilter.start.fit.gauss_newton`, the lowest cost kept: deterministic, not
differentiable.

A fit is ambiguous where another position has nearly the same cost (e^3 = 20 to 1), or the cost
does not rise as its curvature says; where its weights take away nine tenths of the information
on some direction; or where five rows or more were read and one of them alone carries nine
tenths of it. Then rows and span are doubled, up to 32 times as many, and position and velocity
are fitted together, until it is not. What rests on one row to the end, uncontradicted, is taken
as it is.

With ``velocity_sigma`` every start has a covariance: that of the fit (grown by its residuals),
plus the motion from the log's first row to the mean of the rows used, and that sigma for the
velocities. Without it the covariance is None, the filter's ``start.sigma``, unless the filter
has one and a fit waited for more rows or is less certain than that says: then it is NaN for the
other trajectories.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from difffilter.errors import InputError
from difffilter.logs.log import Log, Start
from difffilter.parameters.parameters import Values
from difffilter.sensors.wrapped import check_inputs, seen
from difffilter.start.parts import Part, Startable, part_of
from difffilter.start.rows import flatten
from difffilter.start.waiting import Fitted, Fitter

__all__ = ["from_measurements"]


@torch.no_grad()
def from_measurements(
    recipe: Startable,
    log: Log,
    values: Values | None = None,
    rows: int = 10,
    span: float = 2.0,
    scale: float = 3.0,
    velocity_sigma: float | None = None,
    iterations: int = 10,
    *,
    velocity: Sequence[float] | None = None,
    sensors: Sequence[str] | None = None,
) -> Start:
    """Start of every trajectory: the position by robust least squares.

    The position is taken as constant (or as moving with ``velocity``) over the first ``rows``
    rows with a measurement within ``span`` seconds of the first such row (further rows until
    enough channels were seen to determine it). While a fit is ambiguous, rows and span are
    doubled (see :mod:`difffilter.start.measurements`).

    Args:
        recipe: the filter or estimator; its position is the first states.
        log: z (T, m) or (T, ..., m); rows may be missing, also at the end.
        values: parameter values (noise, stations); the declared ones if missing.
        rows: number of rows, 1 or more; fewer where the target moves fast.
        span: seconds.
        scale: of the Cauchy cost, in the sensors' sigmas.
        velocity_sigma: m/s, how unknown the velocity is; if given, every start has a
            covariance (see :mod:`difffilter.start.measurements`).
        iterations: of the first refinement; the best are refined twice as long.
        velocity: m/s, known or expected; 0 if missing.
        sensors: names of the sensors that make the start; all if missing.

    Returns:
        Mean (..., n) at the first row's time: the position, the velocity, then zeros.

    Raises:
        InputError: a trajectory, named, whose log does not determine a position, and what it
            fits alike; channels, sensors or states that do not fit.
    """
    _check(recipe, log, rows, span)
    constants = recipe.prepare(recipe.published(log.z.dtype) | dict(values or {}))
    part = part_of(recipe, sensors)
    declared = constants.get("start.sigma")
    moving = log.z.new_tensor(_vector(velocity, part.axes))
    unknown = _velocity_sigma(part, declared, velocity_sigma, moving)
    fitter = Fitter(
        part=part,
        constants=constants,
        velocity=moving,
        velocity_sigma=unknown,
        rows=rows,
        span=span,
        scale=scale,
        iterations=iterations,
    )
    fit = fitter.all(flatten(_seen(part, log)))
    covariance = _covariance(fit, part, declared, unknown, velocity_sigma is not None)
    mean = fit.mean.reshape(*log.z.shape[1:-1], -1)
    return Start(mean, None if covariance is None else covariance.reshape(*mean.shape, -1))


def _seen(part: Part, log: Log) -> Log:
    """The log of the part's channels, without what an input withholds."""
    log = log.only(part.channels)
    for sensor in part.sensors:
        check_inputs(sensor, log.inputs)
    return replace(log, z=seen(part.sensors, log.z, log.inputs))


def _check(recipe: Startable, log: Log, rows: int, span: float) -> None:
    """InputError if the log is of other channels, or rows and span are none."""
    if log.channels != recipe.channels:
        raise InputError(
            f"log: found channels {', '.join(log.channels)}, expected {', '.join(recipe.channels)}"
        )
    if rows < 1:
        raise InputError(f"rows: found {rows}, expected 1 or more")
    if not span >= 0.0:
        raise InputError(f"span: found {span}, expected 0 or more seconds")


def _vector(velocity: Sequence[float] | None, axes: int) -> list[float]:
    """The velocity's components, 0 if missing; InputError if they are not ``axes``."""
    found = [0.0] * axes if velocity is None else list(velocity)
    if len(found) != axes:
        raise InputError(f"velocity: found {len(found)} numbers, expected {axes}")
    return found


def _velocity_sigma(
    part: Part, declared: Tensor | None, given: float | None, like: Tensor
) -> Tensor:
    """(axes,), m/s, how unknown each velocity is; infinite where nobody says."""
    if given is not None:
        if declared is None and len(part.states) > part.axes + len(part.velocities):
            raise InputError(
                f"velocity_sigma: found states {', '.join(part.states)}, expected positions and "
                "their velocities, or start.sigma for the others"
            )
        return torch.full_like(like, given)
    if declared is None or not part.velocities:
        return torch.full_like(like, torch.inf)
    return declared.expand(len(part.states))[list(part.velocities)].to(like.dtype)


def _covariance(
    fit: Fitted, part: Part, declared: Tensor | None, sigma: Tensor, wanted: bool
) -> Tensor | None:
    """Covariances (B, n, n), NaN for the filter's ``start.sigma``; None where it serves all.

    The fit's, plus the motion within ``elapsed`` at the velocity's sigma, and that for
    velocities that were not fitted; ``start.sigma`` for the other states.
    """
    n, axes = len(part.states), part.axes
    spread = fit.factor @ fit.factor.mT
    if declared is None and not wanted:
        return None  # nobody says how unknown the velocity is
    if declared is not None and not wanted:
        inverse = declared.expand(n)[:axes].to(spread.dtype).reciprocal()
        white = inverse[:, None] * spread[:, :axes, :axes] * inverse
        wide = torch.linalg.eigvalsh(white)[..., -1] > 1.0
        needed = fit.moving | wide
        if not bool(needed.any()):
            return None
    else:
        needed = torch.ones_like(fit.moving)
    own = torch.zeros_like(fit.mean) if declared is None else declared.square().expand_as(fit.mean)
    extra = own.to(spread.dtype).clone()
    known = torch.isfinite(sigma)
    moved = torch.where(known, sigma, 0.0) * fit.elapsed.unsqueeze(-1)
    extra[:, :axes] = moved.square()
    for i, v in enumerate(part.velocities):
        extra[:, v] = torch.where(fit.moving, 0.0, sigma[i].square())
    total = spread + torch.diag_embed(extra)
    for i, v in enumerate(part.velocities):  # the same velocity moved the position
        shared = torch.where(fit.moving, 0.0, moved[:, i] * extra[:, v].sqrt())
        total[:, i, v] -= shared
        total[:, v, i] -= shared
    if wanted:
        return total
    return torch.where(needed[:, None, None], total, torch.nan)
