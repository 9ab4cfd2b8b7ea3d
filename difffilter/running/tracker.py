"""Streaming: one measurement at a time through the same step as the batch run."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, overload

import torch
from torch import Tensor

from difffilter.core.beliefs import Belief, Measurement, Record, belief
from difffilter.engine.choice import pick, tried
from difffilter.errors import InputError, NonFiniteError
from difffilter.filters.placing import extended
from difffilter.filters.recipe import Recipe, motion_of
from difffilter.filters.stepping import step
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.running.batch import check_finite, eager
from difffilter.running.history import After, History
from difffilter.running.rows import Given, Known, needs_inputs, numbers

if TYPE_CHECKING:
    from difffilter.engine.streaming import Stream

__all__ = ["Tracker"]


class Tracker:
    """A filter with its current belief, for use on a live stream.

    Args:
        filter: the recipe.
        mean: (n,) or (..., n) initial mean.
        covariance: (n, n) or (..., n, n), positive semidefinite.
        values: frozen parameter values; the declared ones if missing.
        temperature: of a checkpoint frozen in its soft form; None for the hard form.
        engine: ``fused`` compiles the step when the tracker is made (or at the first step,
            where that has known inputs); ``torch``; ``auto``: fused where it can.

        history: seconds by which a row may be late (``step(z, time=...)``); None for rows in
            order, told by ``dt``.
        time: of the initial mean, s, with ``history``; None for the first row's.

    Attributes:
        steps: how many rows were taken; dropped: how many were later than ``history``.

    Raises:
        InputError: a mean or a covariance that does not fit the filter, a wrong value.
        EngineError: ``fused`` where the step cannot be compiled.

    Example:
        >>> import torch
        >>> from difffilter import ConstantVelocity, Filter, Position, Tracker, huber
        >>> robust = Filter(ConstantVelocity(axes=1), (Position(axes=1, sigma=2.0),), huber)
        >>> tracker = Tracker(robust, [0.0, 1.0], [[4.0, 0.0], [0.0, 1.0]])
        >>> record = tracker.step([1.2], dt=1.0)
        >>> tracker.belief.mean.shape
        torch.Size([2])
    """

    def __init__(
        self,
        filter: Recipe,
        mean: Tensor | Sequence[float],
        covariance: Tensor | Sequence[Sequence[float]],
        values: Values | None = None,
        temperature: float | None = None,
        engine: str = "auto",
        history: float | None = None,
        time: float | None = None,
    ) -> None:
        self.filter = filter
        self._engine = pick(engine, math.inf)
        self._stream: Stream | None = None
        self._stale = False  # whether the compiled step has moved the belief since it was read
        with torch.inference_mode():
            self._constants = filter.prepare(values, temperature)
            self._dtype = next(iter(self._constants.values())).dtype
            given = self._tensor(mean)
            size = given.shape[-1] - len(filter.states) + len(filter.error_states)
            first = belief(given, self._tensor(covariance), size)
            first = Belief(*extended(motion_of(filter), self._constants, *first[:2]), {})
            if first.mean.shape[-1] != len(filter.states):
                raise InputError(
                    f"mean: found {first.mean.shape[-1]} numbers, "
                    f"expected {len(filter.states)} ({', '.join(filter.states)})"
                )
            self._belief = filter.start(first.mean, first.deviations)
        self.steps = 0
        self._history = None if history is None else History(history, time, self._belief)
        self._informed = needs_inputs(filter)
        single = self._belief.mean.dim() == 1 and self._dtype == torch.float64
        if self._engine == "auto" and not single:
            self._engine = "torch"
        if self._engine != "torch" and not self._informed:
            self._compile({})

    @property
    def belief(self) -> Belief:
        """The current belief: mean (n,) or (..., n), deviations, memory."""
        if self._stale and self._stream is not None:
            self._belief, self._stale = self._stream.belief, False
        return self._belief

    @belief.setter
    def belief(self, belief: Belief) -> None:
        self._belief, self._stale = belief, False
        if self._stream is not None:
            self._stream.set(belief)

    def _compile(self, inputs: Mapping[str, Tensor]) -> None:
        """Go over to the compiled step; ``auto`` stays with torch where there is none."""
        from difffilter.engine.streaming import Stream

        constants, now = self._constants, self._belief
        found = tried(self._engine, lambda: Stream(self.filter, constants, now, inputs))
        if found is None:
            self._engine = "torch"
        else:
            self._stream = found[0]

    @property
    def dropped(self) -> int:
        """Rows that were later than ``history`` and left out."""
        return 0 if self._history is None else self._history.dropped

    @overload
    def step(self, z: Given, dt: float | Tensor, inputs: Known | None = None) -> Record: ...
    @overload
    def step(self, z: Given, *, inputs: Known | None = None, time: float) -> Record | None: ...
    def step(
        self,
        z: Given,
        dt: float | Tensor | None = None,
        inputs: Known | None = None,
        time: float | None = None,
    ) -> Record | None:
        """Predict over dt seconds and condition on z; returns the step's record.

        With ``time``, and a tracker with ``history``, rows may come in any order: the belief is
        that of all rows in order of time. A late row goes back to the belief before it and
        repeats what came since.

        Args:
            z: one number per channel in the filter's order, or a mapping by channel name;
                NaN, None or an absent name where a channel is missing.
            dt: seconds since the last step, 0 or more; time: of the row, s, in its place.
            inputs: known inputs of this step.

        Returns:
            The row's record; None where it is later than ``history``, and left out.

        Raises:
            InputError: a wrong number of channels, an unknown name, dt < 0; the belief
                stays as it was.
            NonFiniteError: the new belief is not finite; the belief stays as it was.
        """
        if (time is None) != (self._history is None) or (dt is None) == (time is None):
            raise InputError(
                "step: found dt or time, expected time with history, and dt without it"
            )
        if self._history is not None and time is not None:
            return self._in_place(self._history, z, inputs, float(time))
        assert dt is not None
        return self._step(z, dt, inputs)

    def _in_place(self, old: History, z: Given, inputs: Known | None, at: float) -> Record | None:
        steps, before = self.steps, self.belief

        def again(belief: Belief, row: Given, dt: float, known: Known | None) -> After:
            self.belief = belief
            record = self._step(row, dt, known)
            return self.belief, record

        try:
            found = old.take(at, z, inputs, again)
        except BaseException:
            self.belief, self.steps = before, steps
            raise
        self.steps = steps + (found is not None)
        return None if found is None else found[1]

    def _step(self, z: Given, dt: float | Tensor, inputs: Known | None) -> Record:
        row = numbers(z, self.filter.channels)
        if self._stream is None and self._engine != "torch":
            self._compile(self._known(inputs))
        if self._stream is not None:
            return self._streamed(self._stream, row, dt, inputs)
        with torch.inference_mode():
            known = self._known(inputs)
            interval = self._tensor(dt)
            if not bool((interval >= 0).all()):
                raise InputError(f"dt: found {dt}, expected 0 or more seconds")
            measurement = Measurement(self._row(row), interval, known)
            after, record = step(self.filter, self._constants, self._belief, measurement)
            for what, tensor in (("mean", after.mean), ("covariance", after.deviations.sum(-1))):
                bad = ~torch.isfinite(tensor)
                if bool(bad.any()):
                    where = bad.reshape(-1, bad.shape[-1]).nonzero()[0].tolist()
                    raise NonFiniteError(what, where[0], self.steps, self._named(what)[where[1]])
            self._belief, self.steps = after, self.steps + 1
            return record

    def feed(
        self,
        z: Tensor,
        dt: Tensor | Sequence[float],
        inputs: Mapping[str, Tensor] | None = None,
    ) -> Track:
        """Many steps at once, as a recording is replayed; the same as one :meth:`step` per row.

        Args:
            z: (T, m) or (T, ..., m), NaN where a channel is missing.
            dt: (T,) or (T, ...), seconds since the step before, 0 or more.
            inputs: known inputs, (T, ...) each.

        Returns:
            Belief and record of each row; its times count from the last step.

        Raises:
            InputError, NonFiniteError: as for :meth:`step`; the belief stays as it was.
        """
        if self._history is not None:
            raise InputError("feed: found a tracker with history, expected step with time")
        rows, interval = self._tensor(z), self._tensor(dt)
        if not bool((interval >= 0).all()):
            raise InputError("dt: found less than 0, expected 0 or more seconds")
        known = {name: self._tensor(value) for name, value in (inputs or {}).items()}
        self.filter.check_inputs(known)
        log = Log(self.filter.channels, interval.cumsum(0), rows, inputs=known)
        if not log.steps:
            raise InputError("z: found no row, expected one or more")
        expected = (*self._belief.mean.shape[:-1], len(self.filter.channels))
        if rows.shape[1:] != expected:
            raise InputError(f"z: found shape {list(rows.shape)}, expected {['T', *expected]}")
        with torch.inference_mode():
            track = self._replayed(log, interval)
            check_finite(track, self.steps)
            assert track.final is not None
            self.belief, self.steps = track.final, self.steps + log.steps
        return track

    def _replayed(self, log: Log, interval: Tensor) -> Track:
        from difffilter.engine.fused import Job, forward

        current, recipe = self.belief, self.filter
        job = Job(recipe, self._constants, log, current, interval)
        found = tried(self._engine, lambda: forward(job))
        if found is not None:
            return recipe.track(log.time, *found[0])
        return eager(recipe, self._constants, log, current, interval)

    def _streamed(
        self,
        stream: Stream,
        row: Tensor | list[float],
        dt: float | Tensor,
        inputs: Known | None,
    ) -> Record:
        """The compiled step."""
        z = row.tolist() if isinstance(row, Tensor) else row
        if (isinstance(row, Tensor) and row.dim() != 1) or len(z) != len(self.filter.channels):
            found = list(row.shape) if isinstance(row, Tensor) else [len(z)]
            raise InputError(f"z: found shape {found}, expected {[len(self.filter.channels)]}")
        if any(map(math.isinf, z)):
            raise InputError("z: found an infinite number, expected finite or missing")
        seconds = float(dt)
        if not seconds >= 0.0:
            raise InputError(f"dt: found {dt}, expected 0 or more seconds")
        known = self._known(inputs) if inputs or self._informed else {}
        record, bad = stream.step(z, seconds, known)
        if bad:
            what, state = stream.place(bad)
            raise NonFiniteError(what, 0, self.steps, self._named(what)[state])
        self.steps, self._stale = self.steps + 1, True
        return record

    def _named(self, what: str) -> tuple[str, ...]:
        return self.filter.states if what == "mean" else self.filter.error_states

    def _known(self, inputs: Known | None) -> dict[str, Tensor]:
        """Known inputs as tensors; InputError if one is missing."""
        known = {name: self._tensor(value) for name, value in (inputs or {}).items()}
        self.filter.check_inputs(known)
        return known

    def _row(self, z: Tensor | list[float]) -> Tensor:
        row = torch.as_tensor(z, dtype=self._dtype)
        expected = (*self._belief.mean.shape[:-1], len(self.filter.channels))
        if row.shape != expected:
            raise InputError(f"z: found shape {list(row.shape)}, expected {list(expected)}")
        if bool(torch.isinf(row).any()):
            raise InputError("z: found an infinite number, expected finite or missing")
        return row

    def _tensor(self, value: object) -> Tensor:
        return torch.as_tensor(value, dtype=self._dtype)
