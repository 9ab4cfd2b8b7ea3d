"""Run a filter over a log: the time loop, for one trajectory or a batch."""

from __future__ import annotations

import torch
from torch import Tensor
from tqdm import tqdm

from difffilter.core.beliefs import Belief, Measurement, Record, belief
from difffilter.engine.choice import ENGINES, eager_seconds, with_engine
from difffilter.errors import InputError, NonFiniteError
from difffilter.filters.placing import extended
from difffilter.filters.recipe import Recipe, motion_of
from difffilter.filters.stepping import step
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.parameters.values import Constants

__all__ = ["ENGINES", "check_finite", "eager", "prepared", "run", "start_belief"]


def start_belief(filter: Recipe, constants: Constants, start: Start) -> Belief:
    """Belief at the start; the filter's ``start.sigma`` where no covariance is given (or NaN).

    A start of the states without the errors of sensors that last has these at 0, as uncertain
    as they are in the long run.
    """
    mean, covariance = start.mean, start.covariance
    # Of the errors: as many as states, but for those that are no plain numbers.
    n = mean.shape[-1] - len(filter.states) + len(filter.error_states)
    without = None if covariance is None else torch.isnan(covariance).all(-1).all(-1)
    if without is not None and covariance is not None and not bool(without.any()):
        given = belief(mean, covariance, n)
        return filter.start(*extended(motion_of(filter), constants, given.mean, given.deviations))
    if "start.sigma" not in constants:
        raise InputError("start: found no covariance, expected one, or a filter with start.sigma")
    deviations = torch.diag_embed(constants["start.sigma"].expand(n))
    deviations = deviations.expand(*mean.shape[:-1], n, n)
    if covariance is not None and without is not None:
        here = without[..., None, None]
        given = belief(mean, torch.where(here, torch.eye(n, dtype=mean.dtype), covariance), n)
        deviations = torch.where(here, deviations, given.deviations)
    return filter.start(*extended(motion_of(filter), constants, mean, deviations))


def run(
    filter: Recipe,
    log: Log,
    values: Values | None = None,
    start: Start | Belief | None = None,
    *,
    temperature: float | None = None,
    progress: bool = False,
    engine: str = "auto",
) -> Track:
    """Run the filter over a log, all trajectories at once.

    Each row: predict over the time since the row before, then condition on the present
    channels. A row without any channel is prediction alone.

    Args:
        filter: the recipe.
        log: z (T, m) for one trajectory or (T, B, m); channels as the filter's.
        values: physical parameter values, differentiable; the declared ones if missing.
        start: initial mean and covariance, or a belief at the first row's time minus its
            dt; the log's own if None.
        temperature: None runs the frozen, hard form.
        progress: show a bar if it takes over two seconds.
        engine: ``torch``; ``fused``: the same step traced, compiled to C and cached (see
            :mod:`difffilter.engine`): float64, without gradient, needs a C compiler; or
            ``auto``: fused where it can and the log is long enough to pay for it.

    Raises:
        InputError: channels or shapes that do not fit, no start.
        NonFiniteError: names the first trajectory, step and state or channel.
    """
    constants, current, intervals = prepared(filter, log, values, start, temperature)

    def fused() -> Track:
        from difffilter.engine.fused import Job, forward

        job = Job(filter, constants, log, current, intervals)
        return filter.track(log.time, *forward(job))

    def plain() -> Track:
        return eager(filter, constants, log, current, intervals, progress)

    given = (*constants.values(), log.z, current.mean, current.deviations)
    differentiable = torch.is_grad_enabled() and any(x.requires_grad for x in given)
    if differentiable and engine == "fused":
        raise InputError("engine fused: found values with gradient, expected none")
    track = with_engine("torch" if differentiable else engine, fused, plain, eager_seconds(log))
    check_finite(track)
    return track


def prepared(
    filter: Recipe,
    log: Log,
    values: Values | None = None,
    start: Start | Belief | None = None,
    temperature: float | None = None,
) -> tuple[Constants, Belief, Tensor]:
    """Constants of a run, the belief of each trajectory at its start, dt before each row.

    Arguments and errors as those of :func:`run`.
    """
    if log.channels != filter.channels:
        raise InputError(
            f"log: found channels {', '.join(log.channels)}, expected {', '.join(filter.channels)}"
        )
    if not log.steps:
        raise InputError("log: found no row, expected one or more")
    filter.check_inputs(log.inputs)
    values = dict(values or {})
    if {log.z.dtype, *(value.dtype for value in values.values())} != {torch.float64}:
        values = filter.published(log.z.dtype) | values  # else what prepare takes by itself
    constants = filter.prepare(values, temperature)
    start = start if start is not None else log.start
    if start is None:
        raise InputError("start: found none, expected an initial mean (see from_measurements)")
    at = None if isinstance(start, Belief) else start.time
    known = {len(filter.states)}
    if isinstance(start, Start):
        known.add(len(filter.bare_states))  # errors that last start at 0
    if start.mean.shape[-1] not in known:
        raise InputError(
            f"start: found mean of shape {list(start.mean.shape)}, "
            f"expected {len(filter.states)} numbers ({', '.join(filter.states)})"
        )
    given = start if isinstance(start, Belief) else start_belief(filter, constants, start)
    fitted = _fit(given, log, filter.states)
    current = filter.start(fitted.mean, fitted.deviations)
    if isinstance(start, Belief):
        current = current._replace(memory={**current.memory, **start.memory})
    return constants, current, log.intervals(at)


def eager(
    filter: Recipe,
    constants: Constants,
    log: Log,
    current: Belief,
    intervals: Tensor,
    progress: bool = False,
) -> Track:
    """The steps one after the other, by torch."""
    rows = log.z.movedim(-1, 1).contiguous().movedim(1, -1)  # trajectories last in memory
    means, deviations, records = [], [], []
    for t in tqdm(range(log.steps), desc="filter", unit="step", delay=2.0, disable=not progress):
        inputs = {name: value[t] for name, value in log.inputs.items()}
        row = Measurement(rows[t], intervals[t], inputs)
        current, record = step(filter, constants, current, row)
        means.append(current.mean)
        deviations.append(current.deviations)
        records.append(record)
    record = Record(*(torch.stack(field) for field in zip(*records, strict=True)))
    return filter.track(log.time, torch.stack(means), torch.stack(deviations), record, current)


def _fit(start: Belief, log: Log, states: tuple[str, ...]) -> Belief:
    """Expand a single start over the log's trajectories."""
    lead = log.z.shape[1:-1]
    n = len(states)
    try:
        mean = start.mean.expand(*lead, n)
    except RuntimeError:
        raise InputError(
            f"start: found mean of shape {list(start.mean.shape)}, expected {[*lead, n]}"
        ) from None
    # Of memory of their own: derivatives along a column cannot be taken of repeated numbers.
    deviations = start.deviations.expand(*lead, *start.deviations.shape[-2:]).contiguous()
    return Belief(mean.contiguous(), deviations, start.memory)


def check_finite(track: Track, before: int = 0) -> None:
    """Raise NonFiniteError at the first step whose belief or innovation is not finite.

    Args:
        before: steps that were done before the track's first.
    """
    deviations = track.deviations.detach()
    checks: list[tuple[str, Tensor, tuple[str, ...]]] = [("mean", track.mean, track.states)]
    if not torch.isfinite(deviations.sum()):
        checks.append(("covariance", deviations.sum(-1), track.errors))
    if track.record is not None:
        checks.insert(0, ("innovation", track.record.innovation, track.channels))
    worst: tuple[int, NonFiniteError] | None = None
    for what, tensor, names in checks:
        bad = ~torch.isfinite(tensor.detach())
        if bool(bad.any()):
            where = bad.reshape(bad.shape[0], -1, bad.shape[-1]).nonzero()[0].tolist()
            if worst is None or where[0] < worst[0]:
                error = NonFiniteError(what, where[1], before + where[0], names[where[2]])
                worst = (where[0], error)
    if worst is not None:
        raise worst[1]
