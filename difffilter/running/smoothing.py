"""The best estimate afterwards: each row from all measurements, or from those until a lag."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief
from difffilter.core.smooth import Backward
from difffilter.engine.choice import eager_seconds, with_engine
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.motions.protocol import Motion
from difffilter.parameters.parameters import Values
from difffilter.parameters.values import Constants
from difffilter.running.batch import check_finite, prepared, run
from difffilter.running.links import Estimates, Links, adapted, check_smoothable, links, step_back
from difffilter.running.reweighting import check_weighs, told, weights_of

__all__ = ["check_smoothable", "smooth", "smoothed"]


def smooth(
    recipe: Recipe,
    log: Log,
    values: Values | None = None,
    start: Start | Belief | None = None,
    *,
    lag: float = math.inf,
    passes: int = 0,
    temperature: float | None = None,
    progress: bool = False,
    engine: str = "auto",
) -> Track:
    """Smoothed estimates of every row: the filter forwards, then conditioning backwards.

    The filter's weights and gates stay as they were: what it rejected counts nothing here
    either. With ``passes`` they are computed again, so many times, from the residuals of the
    smoothed track in sigmas of the noise (see :mod:`difffilter.running.reweighting`); gate and
    recovery then have no say. Differentiable towards ``values``.

    Args:
        recipe: a filter; log, values, start, temperature, progress: as for
            :func:`difffilter.run`.
        lag: s; each row is estimated from the measurements until so much later. All if
            infinite (fixed-interval).
        passes: of reweighting.
        engine: as for :func:`difffilter.run`, of both ways; torch's on the way back with a
            lag, for adaptations and for gradients.

    Returns:
        Track with smoothed means (T, ..., n) and deviations; record and final belief are the
        filter's, of the last pass, with the weights that counted.

    Raises:
        InputError: as for :func:`difffilter.run`; a recipe that has no one Gaussian model from
            row to row; ``passes`` with a filter that does not weigh each channel by itself.
        NonFiniteError: names the first trajectory, step and state or channel.
    """
    if not lag >= 0.0:
        raise InputError(f"lag: found {lag}, expected 0 or more seconds")
    check_weighs(check_smoothable(recipe), passes)
    settings: dict[str, Any] = {"temperature": temperature, "engine": engine}
    track = run(recipe, log, values, start, progress=progress, **settings)
    return smoothed(recipe, log, track, values, start, lag=lag, passes=passes, **settings)


def smoothed(
    recipe: Recipe,
    log: Log,
    track: Track,
    values: Values | None = None,
    start: Start | Belief | None = None,
    *,
    lag: float = math.inf,
    passes: int = 0,
    temperature: float | None = None,
    engine: str = "auto",
) -> Track:
    """A filter's track of a log smoothed: the way back of :func:`smooth`, same arguments."""
    if not lag >= 0.0:
        raise InputError(f"lag: found {lag}, expected 0 or more seconds")
    filter = check_smoothable(recipe)
    check_weighs(filter, passes)
    start = start if start is not None else log.start
    settings: dict[str, Any] = {"lag": lag, "temperature": temperature, "engine": engine}
    track = _back(filter, log, track, values, start, **settings)
    constants = prepared(filter, log, values, start, temperature)[0] if passes else Constants({})
    for _ in range(passes):
        weight = weights_of(filter, constants, log, track)
        again, weighed = told(filter, log, weight)
        known = {n: v for n, v in (values or {}).items() if n in again.declarations}
        track = run(again, weighed, known, start, temperature=temperature, engine="torch")
        track = _back(again, weighed, track, known, start, **settings)
        assert track.record is not None
        record = track.record._replace(weight=weight, present=~torch.isnan(log.z))
        track = replace(track, record=record)
    return track


def _back(
    filter: Filter,
    log: Log,
    track: Track,
    values: Values | None,
    start: Start | Belief | None,
    *,
    lag: float,
    temperature: float | None,
    engine: str,
) -> Track:
    """The way back, once."""
    constants, first, intervals = prepared(filter, log, values, start, temperature)
    if log.steps == 1:
        return track
    job = constants, log, track
    differentiable = torch.is_grad_enabled() and any(
        x.requires_grad for x in (*constants.values(), track.mean, track.deviations)
    )

    def fused() -> Estimates:
        from difffilter.running.reversal import compiled_back

        return compiled_back(filter, *job, intervals)

    def plain() -> Estimates:
        steps = links(filter, *job, first, intervals)
        if math.isinf(lag):
            return _interval(filter.motion, track, steps)
        return _lagged(filter.motion, track, steps, _until(log.time, lag))

    able = not differentiable and math.isinf(lag) and not adapted(filter)
    seconds = eager_seconds(log)
    mean, deviations = with_engine(engine if able else "torch", fused, plain, seconds)
    found = replace(track, mean=mean, deviations=deviations)
    check_finite(found)
    return found


def _interval(motion: Motion, track: Track, steps: Links) -> Estimates:
    """From the last row to the first."""
    now = track.mean[-1], track.deviations[-1]
    found = [now]
    for t in reversed(range(len(steps.predicted))):
        back = Backward(steps.back.gain[t], steps.back.left[t])
        now = step_back(motion, track.mean[t], steps.predicted[t], back, now)
        found.append(now)
    means, spreads = zip(*found[::-1], strict=True)
    return torch.stack(means), torch.stack(spreads)


def _until(time: Tensor, lag: float) -> Tensor:
    """(T, ...), the last row that is at most ``lag`` later than each row."""
    flat = time.reshape(len(time), -1).mT.contiguous()
    last = torch.searchsorted(flat, flat + lag, right=True) - 1
    rows = torch.arange(len(time))
    return torch.maximum(last, rows).mT.reshape(time.shape)


def _lagged(motion: Motion, track: Track, steps: Links, last: Tensor) -> Estimates:
    """All rows at once, each from its last row back: as many passes as the lag has rows."""
    lead = track.mean.shape[:-1]
    last = last.reshape(*last.shape, *[1] * (len(lead) - last.dim())).expand(lead)
    rows = torch.arange(lead[0]).reshape(-1, *[1] * (len(lead) - 1)).expand(lead)

    def take(x: Tensor, index: Tensor) -> Tensor:
        core = x.shape[len(lead) :]
        return x.gather(0, index.reshape(*lead, *[1] * len(core)).expand(*lead, *core))

    at = last
    mean, deviations = take(track.mean, at), take(track.deviations, at)
    for _ in range(int((last - rows).max())):
        moves = at > rows
        at = torch.where(moves, at - 1, at)
        here = at.clamp_max(lead[0] - 2)
        back = Backward(take(steps.back.gain, here), take(steps.back.left, here))
        filtered, predicted = take(track.mean, here), take(steps.predicted, here)
        new = step_back(motion, filtered, predicted, back, (mean, deviations))
        mean = torch.where(moves.unsqueeze(-1), new[0], mean)
        deviations = torch.where(moves[..., None, None], new[1], deviations)
    return mean, deviations
