"""Streaming: one measurement at a time through the same step as the batch run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from difffilter.belief import Belief, Measurement, Record, belief
from difffilter.errors import InputError, NonFiniteError
from difffilter.filter import Filter
from difffilter.parameters import Values
from difffilter.step import step

__all__ = ["Tracker"]


class Tracker:
    """A filter with its current belief, for use on a live stream.

    Args:
        filter: the recipe.
        mean: (n,) or (..., n) initial mean.
        covariance: (n, n) or (..., n, n), positive semidefinite.
        values: frozen parameter values; the declared ones if missing.
        temperature: of a checkpoint frozen in its soft form; None for the hard form.

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
        filter: Filter,
        mean: Tensor | Sequence[float],
        covariance: Tensor | Sequence[Sequence[float]],
        values: Values | None = None,
        temperature: float | None = None,
    ) -> None:
        self.filter = filter
        with torch.inference_mode():
            self._constants = filter.prepare(values, temperature)
            self._dtype = next(iter(self._constants.values())).dtype
            first = belief(self._tensor(mean), self._tensor(covariance))
            if first.mean.shape[-1] != len(filter.states):
                raise InputError(
                    f"mean: found {first.mean.shape[-1]} numbers, "
                    f"expected {len(filter.states)} ({', '.join(filter.states)})"
                )
            self.belief: Belief = filter.start(first.mean, first.deviations)
        self.steps = 0

    def step(
        self,
        z: Tensor | Sequence[float | None] | Mapping[str, float | None],
        dt: float | Tensor,
        inputs: Mapping[str, Tensor | Sequence[float] | float] | None = None,
    ) -> Record:
        """Predict over dt seconds and condition on z; returns the step's record.

        Args:
            z: one number per channel in the filter's order, or a mapping by channel name;
                NaN, None or an absent name where a channel is missing.
            dt: seconds since the last step, 0 or more.
            inputs: known inputs of this step.

        Raises:
            InputError: a wrong number of channels, an unknown name, dt < 0; the belief
                stays as it was.
            NonFiniteError: the new belief is not finite; the belief stays as it was.
        """
        with torch.inference_mode():
            row = self._row(z)
            interval = self._tensor(dt)
            if not bool((interval >= 0).all()):
                raise InputError(f"dt: found {dt}, expected 0 or more seconds")
            known = {name: self._tensor(value) for name, value in (inputs or {}).items()}
            self.filter.check_inputs(known)
            measurement = Measurement(row, interval, known)
            after, record = step(self.filter, self._constants, self.belief, measurement)
            for what, tensor in (("mean", after.mean), ("covariance", after.deviations.sum(-1))):
                bad = ~torch.isfinite(tensor)
                if bool(bad.any()):
                    where = bad.reshape(-1, bad.shape[-1]).nonzero()[0].tolist()
                    name = self.filter.states[where[1]]
                    raise NonFiniteError(what, where[0], self.steps, name)
            self.belief, self.steps = after, self.steps + 1
            return record

    def _row(self, z: Tensor | Sequence[float | None] | Mapping[str, float | None]) -> Tensor:
        channels = self.filter.channels
        if isinstance(z, Mapping):
            unknown = set(z) - set(channels)
            if unknown:
                raise InputError(
                    f"z: found channel {min(unknown)!r}, expected {', '.join(channels)}"
                )
            z = [z.get(name) for name in channels]
        if not isinstance(z, Tensor):
            try:
                z = self._tensor([float("nan") if v is None else float(v) for v in z])
            except (TypeError, ValueError):
                raise InputError(f"z: found {z!r}, expected numbers or None") from None
        row = z.to(self._dtype)
        expected = (*self.belief.mean.shape[:-1], len(channels))
        if row.shape != expected:
            raise InputError(f"z: found shape {list(row.shape)}, expected {list(expected)}")
        if bool(torch.isinf(row).any()):
            raise InputError("z: found an infinite number, expected finite or missing")
        return row

    def _tensor(self, value: object) -> Tensor:
        return torch.as_tensor(value, dtype=self._dtype)
