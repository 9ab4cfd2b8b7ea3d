"""Errors that name what is wrong and where."""

from __future__ import annotations

__all__ = [
    "CheckpointError",
    "DifffilterError",
    "EngineError",
    "InputError",
    "LogError",
    "NonFiniteError",
    "RankError",
]


class DifffilterError(Exception):
    """Base of the library's errors; the message is one line for the user."""


class InputError(DifffilterError, ValueError):
    """Wrong input: a scenario, an option, a shape or a value."""


class LogError(InputError):
    """A log file that cannot be read; the message names file and line."""


class CheckpointError(InputError):
    """A checkpoint that is damaged, of another version or does not fit."""


class EngineError(InputError):
    """The fused engine cannot run this here: no compiler, or an operation without a rule."""


class RankError(DifffilterError, RuntimeError):
    """One of several processes was lost, or cannot be reached."""


class NonFiniteError(DifffilterError, ArithmeticError):
    """A belief or a gradient turned non-finite.

    Attributes:
        trajectory: index in the batch (0 where there is none).
        step: row of the log, from 0.
        channel: name of the state or channel.
    """

    def __init__(self, what: str, trajectory: int, step: int, channel: str) -> None:
        self.trajectory, self.step, self.channel = trajectory, step, channel
        super().__init__(
            f"{what} is not finite: trajectory {trajectory}, step {step}, channel {channel}"
        )
