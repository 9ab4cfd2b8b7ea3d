"""Q and R of a plain filter by expectation-maximisation: a cross-check of what tuning finds.

The smoother tells the moments of what the motion and the sensors did, and these are the next
scales: of every row's process noise w ~ N(0, I), which enters as L w, and of every measured
error (R. H. Shumway and D. S. Stoffer, 1982, eqs. (9) to (14), here for scales of the columns of
L and of single channels [reconstruction])::

    scale'^2 = scale^2 mean(E[w^2]),    sigma'^2 = sigma^2 mean(E[(z - h(x))^2] / r)

No step lowers the likelihood of a linear model. Steps are extrapolated as of R. Varadhan and
C. Roland, 2008 (SQUAREM), where the likelihood does not fall by it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement
from difffilter.core.smooth import disturbance
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.prediction import predict
from difffilter.logs.log import Log, Start
from difffilter.parameters.parameters import Values
from difffilter.running.batch import prepared, run
from difffilter.running.links import adapted
from difffilter.running.smoothing import smoothed
from difffilter.sensors.information import stacked_noise
from difffilter.weights.registry import plain

__all__ = ["Maximum", "expectation_maximisation"]


@dataclass(frozen=True)
class Maximum:
    """What expectation-maximisation found.

    Attributes:
        values: physical values, those that were estimated and the others as they were.
        log_likelihood: sum over all rows, at ``values``.
        steps: how many; converged: whether the last one moved no scale by more than
            ``tolerance``.
    """

    values: Values
    log_likelihood: float
    steps: int
    converged: bool


class _Moments(NamedTuple):
    """Mean second moments, in units of the present scales, and the log likelihood."""

    process: Tensor  # (q,), of each column of the process noise
    error: Tensor  # (m,), of each channel
    likelihood: float


class _Scale(NamedTuple):
    """An entry of a parameter, and the columns or channels whose standard deviation it scales."""

    name: str
    entry: int
    process: tuple[int, ...]
    channels: tuple[int, ...]


def expectation_maximisation(
    filter: Filter,
    log: Log,
    values: Values | None = None,
    start: Start | Belief | None = None,
    *,
    tuned: tuple[str, ...] = (),
    steps: int = 200,
    tolerance: float = 1e-7,
) -> Maximum:
    """The scales of Q and R that make a log most likely, by expectation-maximisation.

    Exact for linear models. Of others it maximises by the linearised smoother, so that it ends
    near the maximum of the filter's likelihood, not at it.

    Args:
        filter: plain: no weight, gate, adaptation or recovery.
        log, values, start: as for :func:`difffilter.run`.
        tuned: names of parameters that scale columns of the process noise or channels'
            noise; those declared ``tuned`` if empty.
        steps: at most; tolerance: relative change of a scale at which to stop.

    Raises:
        InputError: a filter that is not plain, a parameter that is no such scale.
    """
    _check(filter)
    now = dict(filter.published(log.z.dtype)) | dict(values or {})
    names = tuned or tuple(n for n, p in filter.declarations.items() if p.tuned)
    scales = _scales(filter, log, now, start, names)
    theta = torch.stack([now[s.name].reshape(-1)[s.entry].log() for s in scales])
    best = _moments(filter, log, _with(now, scales, theta), start)
    for step in range(1, steps + 1):
        first = theta + _change(scales, best)
        after = _moments(filter, log, _with(now, scales, first), start)
        second = first + _change(scales, after)
        r, v = first - theta, (second - first) - (first - theta)
        length = -r.norm() / v.norm().clamp_min(torch.finfo(v.dtype).tiny)
        reach = torch.clamp(length, -1e3, -1.0)
        further = theta - 2.0 * reach * r + reach.square() * v
        found = _moments(filter, log, _with(now, scales, further), start)
        if not found.likelihood >= after.likelihood:
            further, found = first, after
        theta, best = further, found
        if float(r.abs().max()) < tolerance:
            return Maximum(_with(now, scales, theta), best.likelihood, step, True)
    return Maximum(_with(now, scales, theta), best.likelihood, steps, False)


def _check(filter: Filter) -> None:
    found = ""
    if not isinstance(filter, Filter):
        found = type(filter).__name__
    elif filter.weight != plain or filter.gate is not None:
        found = "a filter that weighs or gates"
    elif adapted(filter):
        found = "a filter that adapts"
    elif not filter.motion.flat or filter.linearise != "taylor":
        found = "cubature or a state that is no vector"
    if found:
        raise InputError(f"expectation-maximisation: found {found}, expected a plain filter")


def _scales(
    filter: Filter, log: Log, values: Values, start: Start | Belief | None, names: tuple[str, ...]
) -> list[_Scale]:
    """What each entry of the parameters scales, by doubling it."""
    if not names:
        raise InputError("expectation-maximisation: found no tuned parameter, expected one or more")
    base = _factors(filter, log, values, start)
    found = []
    for name in names:
        if name not in values:
            known = ", ".join(values)
            raise InputError(f"expectation-maximisation: found {name}, expected one of {known}")
        for entry in range(values[name].numel()):
            doubled = values[name].clone()
            doubled.reshape(-1)[entry] *= 2.0
            other = _factors(filter, log, {**values, name: doubled}, start)
            parts = [_scaled(a, b) for a, b in zip(base, other, strict=True)]
            if None in parts or not any(parts):
                raise InputError(
                    f"expectation-maximisation: found {name}, expected a standard deviation of "
                    "process noise or of single channels alone"
                )
            found.append(_Scale(name, entry, parts[0] or (), parts[1] or ()))
    return found


def _factors(
    filter: Filter, log: Log, values: Values, start: Start | Belief | None
) -> tuple[Tensor, Tensor]:
    """Process columns (R, q) and channels' sigmas (R, m) of all rows at the start's mean."""
    constants, first, intervals = prepared(filter, log, values, start)
    row = _rows(log, intervals)
    lead = log.z.shape[:-1]
    wide = first.deviations.expand(*lead, *first.deviations.shape[-2:])
    at = Belief(first.mean.expand(*lead, -1), wide)
    process = predict(filter, constants, at, row).process
    noise = stacked_noise(filter.sensors, at.mean, log.inputs, constants)
    if noise.common.shape[-1]:
        raise InputError(
            "expectation-maximisation: found noise common to channels, expected independent noise"
        )
    columns = process.expand(*lead, *process.shape[-2:])
    return columns.reshape(-1, columns.shape[-1]), noise.total.sqrt().expand_as(log.z).flatten(
        0, -2
    )


def _scaled(before: Tensor, after: Tensor) -> tuple[int, ...] | None:
    """Columns that were doubled; None if another than none or all of one changed otherwise."""
    same = torch.isclose(after, before, rtol=1e-9, atol=0.0).all(0)
    twice = torch.isclose(after, 2.0 * before, rtol=1e-9, atol=0.0).all(0)
    if not bool((same | twice).all()):
        return None
    return tuple((twice & ~same).nonzero().flatten().tolist())


def _rows(log: Log, intervals: Tensor) -> Measurement:
    lead = log.z.shape[:-1]
    dt = intervals.reshape(*intervals.shape, *[1] * (len(lead) - intervals.dim())).expand(lead)
    return Measurement(log.z, dt, log.inputs)


def _moments(filter: Filter, log: Log, values: Values, start: Start | Belief | None) -> _Moments:
    """The expectation: of all rows' process noise and errors, by the smoother."""
    with torch.no_grad():
        constants, first, intervals = prepared(filter, log, values, start)
        track = run(filter, log, values, start)
        later = smoothed(filter, log, track, values, start)
        row = _rows(log, intervals)
        mean, deviations = (
            torch.cat([x.unsqueeze(0), y[:-1]])
            for x, y in ((first.mean, track.mean), (first.deviations, track.deviations))
        )
        step = predict(filter, constants, Belief(mean, deviations), row)
        told = disturbance(step.moved, step.process)
        none = step.process.new_zeros(*later.mean.shape[:-1], step.process.shape[-1])
        noise = told.mean(none, later.mean - step.mean)
        spread = torch.cat([told.left, told.gain @ later.deviations], -1).square().sum(-1)
        acts = (step.process != 0.0).any(-2).expand_as(noise)
        process = _mean(noise.square() + spread, acts)
        errors = []
        at = 0
        for sensor in filter.sensors:
            z = log.z[..., at : (at := at + len(sensor.channels))]
            value, seen = sensor.observe(later.mean, later.deviations, log.inputs, constants)
            residual = sensor.residual(torch.where(torch.isnan(z), value, z), value)
            total = sensor.noise(later.mean, log.inputs, constants).total
            errors.append((residual.square() + seen.square().sum(-1)) / total)
        error = _mean(torch.cat(errors, -1), ~torch.isnan(log.z))
        assert track.record is not None
        return _Moments(process, error, float(track.record.log_density.sum()))


def _mean(squares: Tensor, counted: Tensor) -> Tensor:
    """Sum and count (2, columns) over all rows."""
    total = torch.where(counted, squares, 0.0).flatten(0, -2).sum(0)
    return torch.stack([total, counted.flatten(0, -2).sum(0).to(total.dtype)])


def _change(scales: list[_Scale], moments: _Moments) -> Tensor:
    """By how much the maximisation moves the log of each scale."""
    found = []
    for scale in scales:
        parts = [moments.process[:, [*scale.process]], moments.error[:, [*scale.channels]]]
        total, count = torch.cat(parts, -1).sum(-1)
        found.append(0.5 * (total / count.clamp_min(1.0)).log() if count > 0 else total * 0.0)
    return torch.stack(found)


def _with(values: Values, scales: list[_Scale], theta: Tensor) -> dict[str, Tensor]:
    """The values with each scale set to exp(theta)."""
    found = {name: value.clone() for name, value in values.items()}
    for scale, log in zip(scales, theta, strict=True):
        found[scale.name].reshape(-1)[scale.entry] = log.exp()
    return found
