"""The best estimate afterwards: each row from all measurements, or from those until a lag."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement
from difffilter.core.cubature import doubled
from difffilter.core.smooth import Backward, backward
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.filters.mixture import Mixture
from difffilter.filters.prediction import predict
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.parameters.values import Constants
from difffilter.running.batch import check_finite, prepared, run

__all__ = ["check_smoothable", "smooth", "smoothed"]


class Steps(NamedTuple):
    """From each row but the last to the next one.

    Attributes:
        predicted: (T - 1, ..., n), means.
        back: gains and remaining deviations (T - 1, ...).
    """

    predicted: Tensor
    back: Backward


def smooth(
    recipe: Recipe,
    log: Log,
    values: Values | None = None,
    start: Start | Belief | None = None,
    *,
    lag: float = math.inf,
    temperature: float | None = None,
    progress: bool = False,
    engine: str = "auto",
) -> Track:
    """Smoothed estimates of every row: the filter forwards, then conditioning backwards.

    The filter's weights and gates stay as they were: what it rejected counts nothing here
    either. Differentiable towards ``values``.

    Args:
        recipe: a filter; log, values, start, temperature, progress: as for
            :func:`difffilter.run`.
        lag: s; each row is estimated from the measurements until so much later. All if
            infinite (fixed-interval).
        engine: of the filter; the way back is torch's.

    Returns:
        Track with smoothed means (T, ..., n) and deviations; record and final belief are the
        filter's.

    Raises:
        InputError: as for :func:`difffilter.run`; a recipe that has no one Gaussian model from
            row to row: fusion, an adaptation, recovery by inflation, a weighed prior.
        NonFiniteError: names the first trajectory, step and state or channel.
    """
    if not lag >= 0.0:
        raise InputError(f"lag: found {lag}, expected 0 or more seconds")
    check_smoothable(recipe)
    track = run(
        recipe, log, values, start, temperature=temperature, progress=progress, engine=engine
    )
    return smoothed(recipe, log, track, values, start, lag=lag, temperature=temperature)


def smoothed(
    recipe: Recipe,
    log: Log,
    track: Track,
    values: Values | None = None,
    start: Start | Belief | None = None,
    *,
    lag: float = math.inf,
    temperature: float | None = None,
) -> Track:
    """A filter's track of a log smoothed: the way back of :func:`smooth`, same arguments."""
    if not lag >= 0.0:
        raise InputError(f"lag: found {lag}, expected 0 or more seconds")
    filter = check_smoothable(recipe)
    constants, _, intervals = prepared(filter, log, values, start, temperature)
    if log.steps == 1:
        return track
    steps = _steps(filter, constants, log, track, intervals)
    if math.isinf(lag):
        mean, deviations = _interval(track, steps)
    else:
        mean, deviations = _lagged(track, steps, _until(log.time, lag))
    found = replace(track, mean=mean, deviations=deviations)
    check_finite(found)
    return found


def check_smoothable(recipe: object) -> Filter:
    """The filter; InputError where its rows are not linked by one Gaussian model."""
    found = ""
    if isinstance(recipe, Mixture):
        found = "a mixture, whose modes mix at every row"
    elif not isinstance(recipe, Filter):
        raise InputError(f"smooth: found {type(recipe).__name__}, expected a filter")
    elif recipe.adaptation is not None:
        found = "an adaptation, which changes the prediction by what it saw"
    elif recipe.recovery is not None and recipe.recovery.action == "inflate":
        found = "recovery by inflation"
    elif recipe.weigh_prior:
        found = "weigh_prior"
    elif not recipe.motion.flat:
        found = "a state on a manifold (retract)"
    if found:
        raise InputError(f"smooth: found {found}, expected one filter without it")
    assert isinstance(recipe, Filter)
    return recipe


def _steps(
    filter: Filter, constants: Constants, log: Log, track: Track, intervals: Tensor
) -> Steps:
    """All rows' predictions and gains at once."""
    at = Belief(track.mean[:-1], track.deviations[:-1])
    inputs = {name: value[1:] for name, value in log.inputs.items()}
    lead = (..., *[None] * (log.z.dim() - 2 - (intervals.dim() - 1)))
    dt = intervals[1:][lead].expand(log.z.shape[:-1][0] - 1, *log.z.shape[1:-1])
    step = predict(filter, constants, at, Measurement(log.z[1:], dt, inputs))
    n = len(filter.states)
    filtered = at.deviations if step.moved.shape[-1] == n else doubled(at.deviations)
    return Steps(step.mean, backward(filtered, step.moved, step.process))


def _interval(track: Track, steps: Steps) -> tuple[Tensor, Tensor]:
    """From the last row to the first."""
    mean, deviations = track.mean[-1], track.deviations[-1]
    means, spreads = [mean], [deviations]
    for t in reversed(range(len(steps.predicted))):
        back = Backward(steps.back.gain[t], steps.back.left[t])
        mean = back.mean(track.mean[t], mean - steps.predicted[t])
        deviations = back.deviations(deviations)
        means.append(mean)
        spreads.append(deviations)
    return torch.stack(means[::-1]), torch.stack(spreads[::-1])


def _until(time: Tensor, lag: float) -> Tensor:
    """(T, ...), the last row that is at most ``lag`` later than each row."""
    flat = time.reshape(len(time), -1).mT.contiguous()
    last = torch.searchsorted(flat, flat + lag, right=True) - 1
    rows = torch.arange(len(time))
    return torch.maximum(last, rows).mT.reshape(time.shape)


def _lagged(track: Track, steps: Steps, last: Tensor) -> tuple[Tensor, Tensor]:
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
        new = back.mean(take(track.mean, here), mean - take(steps.predicted, here))
        mean = torch.where(moves.unsqueeze(-1), new, mean)
        deviations = torch.where(moves[..., None, None], back.deviations(deviations), deviations)
    return mean, deviations
