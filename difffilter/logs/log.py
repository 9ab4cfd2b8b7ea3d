"""Logs: measurements over time for one or many trajectories, with truth where known."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from difffilter.errors import InputError

__all__ = ["Log", "Rows", "Start", "stack_logs"]


#: Inputs with one entry per channel.
PER_CHANNEL = ("fault.mean", "fault.variance", "ideal.error", "ideal.variance", "hidden")


@dataclass(frozen=True)
class Start:
    """Where a filter starts.

    Attributes:
        mean: (..., n).
        covariance: (..., n, n), or None for the filter's own ``start.sigma``; NaN throughout
            for those trajectories that take it.
        time: seconds, at or before the first row, a number or a tensor with one; None for the
            first row's time.

    Raises:
        InputError: a time that is not one finite number.
    """

    mean: Tensor
    covariance: Tensor | None = None
    time: float | None = None

    def __post_init__(self) -> None:
        if self.time is None:
            return
        try:
            time = float(self.time)
        except (TypeError, ValueError, RuntimeError):
            raise InputError(f"start.time: found {self.time!r}, expected one number") from None
        if not math.isfinite(time):
            raise InputError(f"start.time: found {time}, expected a finite number")
        object.__setattr__(self, "time", time)


@dataclass(frozen=True)
class Rows:
    """Rows of measurements as they are, unchecked: what losses and metrics read.

    A :class:`Log` is checked rows; a traced step makes single ones.

    Attributes:
        channels: names of the m channels.
        time: (T,) or (T, ...), seconds, non-decreasing.
        z: (T, ..., m), NaN where a channel is missing.
        truth: (T, ..., q) or None.
        truth_states: names of the q true states.
        inputs: known inputs, each with T first: (T, ..., *).
        start: prescribed start (simulated logs), or None: start from the measurements.
        names: one name per trajectory, for messages.
    """

    channels: tuple[str, ...]
    time: Tensor
    z: Tensor
    truth: Tensor | None = None
    truth_states: tuple[str, ...] = ()
    inputs: Mapping[str, Tensor] = field(default_factory=dict)
    start: Start | None = None
    names: tuple[str, ...] = ()

    @property
    def steps(self) -> int:
        """Number of rows."""
        return self.z.shape[0]

    @property
    def trajectories(self) -> int:
        """Number of trajectories (1 for a log without that dimension)."""
        return self.z.shape[1] if self.z.dim() > 2 else 1

    @property
    def present(self) -> Tensor:
        """(T, ..., m), whether a channel was measured."""
        return ~torch.isnan(self.z)

    @property
    def measured(self) -> Tensor:
        """(T, ...), whether a row has at least one measurement."""
        return self.present.any(-1)


@dataclass(frozen=True)
class Log(Rows):
    """Checked rows of measurements; the first dimension is time, ``...`` the trajectories.

    Attributes as those of :class:`Rows`.

    Raises:
        InputError: shapes that do not fit, infinite measurements, times that are not finite.
    """

    def __post_init__(self) -> None:
        if self.z.shape[-1] != len(self.channels):
            raise InputError(
                f"log: found {self.z.shape[-1]} columns of measurements, "
                f"expected {len(self.channels)} channels"
            )
        if torch.isinf(self.z).any():
            raise InputError("log: found an infinite measurement, expected finite or missing")
        lead = self.z.shape[:-1]
        if not lead:
            raise InputError("log: found measurements without a dimension of time, expected (T, m)")
        if self.time.shape not in (lead, lead[:1]):
            raise InputError(
                f"log: found times of shape {list(self.time.shape)}, expected {list(lead)}"
            )
        if not torch.isfinite(self.time).all():
            raise InputError("log: found a time that is not finite")
        if self.truth is not None:
            expected = (*lead, len(self.truth_states))
            if self.truth.shape != expected:
                raise InputError(
                    f"log: found truth of shape {list(self.truth.shape)}, expected {list(expected)}"
                )
        for name, value in self.inputs.items():
            if value.shape[:1] != lead[:1]:
                raise InputError(
                    f"log: found input {name} of shape {list(value.shape)}, "
                    f"expected {self.steps} rows"
                )

    def intervals(self, start: float | None = None) -> Tensor:
        """dt before each row, (T,) or (T, ...); 0 at the first row without a start time."""
        first = self.time[:1] if start is None else torch.full_like(self.time[:1], start)
        dt = torch.diff(torch.cat([first, self.time]), dim=0)
        if bool((dt < 0).any()):
            row = (
                int((dt < 0).flatten(1).any(-1).nonzero()[0])
                if dt.dim() > 1
                else int((dt < 0).nonzero()[0])
            )
            raise InputError(f"log: time decreases at row {row}, expected non-decreasing times")
        return dt

    def select(self, index: Sequence[int] | Tensor) -> Log:
        """The trajectories at ``index`` (a batched log)."""
        at = torch.as_tensor(index, dtype=torch.long)
        start = self.start
        if start is not None and start.mean.dim() > 1:  # else one for all
            one = start.covariance
            covariance = one if one is None or one.dim() < 3 else one[at]
            start = Start(start.mean[at], covariance, start.time)
        return replace(
            self,
            time=self.time if self.time.dim() == 1 else self.time[:, at],
            z=self.z[:, at],
            truth=None if self.truth is None else self.truth[:, at],
            inputs={n: v[:, at] if v.dim() > 1 else v for n, v in self.inputs.items()},
            start=start,
            names=tuple(self.names[i] for i in at.tolist()) if self.names else (),
        )

    def alone(self, index: int = 0) -> Log:
        """One trajectory of a batch, z (T, m), without its start."""
        one = self.select([index])
        return replace(
            one,
            time=one.time if one.time.dim() == 1 else one.time[:, 0],
            z=one.z[:, 0],
            truth=None if one.truth is None else one.truth[:, 0],
            inputs={n: v[:, 0] if v.dim() > 1 else v for n, v in one.inputs.items()},
            start=None,
        )

    def only(self, channels: Sequence[str]) -> Log:
        """The log with some of its channels, in the given order; InputError if one is absent."""
        if tuple(channels) == self.channels:
            return self
        for name in channels:
            if name not in self.channels:
                raise InputError(
                    f"log: found channels {', '.join(self.channels)}, expected {name} among them"
                )
        at = [self.channels.index(name) for name in channels]
        per_channel = {
            name: value[..., at] if name in PER_CHANNEL else value
            for name, value in self.inputs.items()
        }
        return replace(self, channels=tuple(channels), z=self.z[..., at], inputs=per_channel)

    def rows(self, first: int, last: int) -> Log:
        """Rows first..last-1, without the prescribed start unless first is 0."""
        return replace(
            self,
            time=self.time[first:last],
            z=self.z[first:last],
            truth=None if self.truth is None else self.truth[first:last],
            inputs={name: value[first:last] for name, value in self.inputs.items()},
            start=self.start if first == 0 else None,
        )

    def to(self, dtype: torch.dtype) -> Log:
        """The same log in another floating-point precision."""
        start = self.start
        if start is not None:
            covariance = None if start.covariance is None else start.covariance.to(dtype)
            start = Start(start.mean.to(dtype), covariance, start.time)
        return replace(
            self,
            time=self.time.to(dtype),
            z=self.z.to(dtype),
            truth=None if self.truth is None else self.truth.to(dtype),
            inputs={name: value.to(dtype) for name, value in self.inputs.items()},
            start=start,
        )


def stack_logs(logs: Sequence[Log]) -> Log:
    """One batched log of single ones; shorter ones are padded with missing rows.

    Padded rows repeat the last time (dt = 0), so that the belief stays as it is; they have
    no measurement and NaN truth.

    Raises:
        InputError: no log, or logs with different channels, truth or inputs.
    """
    if not logs:
        raise InputError("logs: found none, expected at least one")
    first = logs[0]
    for log in logs[1:]:
        if log.channels != first.channels:
            raise InputError(
                f"logs: found channels {', '.join(log.channels)} beside {', '.join(first.channels)}"
            )
        if log.truth_states != first.truth_states or set(log.inputs) != set(first.inputs):
            raise InputError("logs: found logs with different truth or input columns")
    steps = max(log.steps for log in logs)

    def pad(x: Tensor, value: float | None) -> Tensor:
        missing = steps - x.shape[0]
        tail = x[-1:].expand(missing, *x.shape[1:])
        return torch.cat([x, tail if value is None else torch.full_like(tail, value)])

    def each(parts: Sequence[Tensor], value: float | None) -> Tensor:
        return torch.stack([pad(part, value) for part in parts], dim=1)

    nan = float("nan")
    truth = [log.truth for log in logs if log.truth is not None]
    return Log(
        channels=first.channels,
        time=each([log.time for log in logs], None),
        z=each([log.z for log in logs], nan),
        truth=each(truth, nan) if len(truth) == len(logs) else None,
        truth_states=first.truth_states,
        inputs={name: each([log.inputs[name] for log in logs], None) for name in first.inputs},
        names=tuple(name for log in logs for name in (log.names or ("",))),
    )
