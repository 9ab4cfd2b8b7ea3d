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
    "digits",
    "printable",
    "shown",
]


def shown(value: object, limit: int = 80) -> str:
    """What was found, for a message: its ``repr``, cut after ``limit`` characters.

    Example:
        >>> shown("a" * 100, 10)
        "'aaaaaaaaa..."
        >>> shown(10 ** 5000)
        'a whole number of too many digits'
    """
    if isinstance(value, str | bytes):
        value = value[: limit + 1]
    try:
        text = repr(value)
    except ValueError:  # Python prints no more than 4300 digits
        return f"a {'whole number' if isinstance(value, int) else 'list'} of too many digits"
    except RecursionError:
        return "what is nested too deep"
    return text if len(text) <= limit else f"{text[:limit]}..."


def digits(value: float) -> str:
    """A number for a table: three decimals from 0.1 to 1000, else its leading digits.

    Example:
        >>> digits(6.1416), digits(0.00034), digits(12345.6), digits(0.0)
        ('6.142', '0.00034', '1.235e+04', '0')
    """
    size = abs(value)
    if size == 0.0:
        return "0"
    if not 0.1 <= size < 1000.0:
        return f"{value:.4g}" if size > 1.0 else f"{value:.3g}"
    return f"{value:.3f}"


class DifffilterError(Exception):
    """Base of the library's errors; the message is one line for the user.

    However long what was found is, and whatever is in it: no control characters, the middle left
    out beyond a thousand characters.
    """

    def __init__(self, message: str = "") -> None:
        super().__init__(printable(str(message)))


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


def printable(text: str, most: int = 1000) -> str:
    """Text for a terminal: no control characters, the middle left out where it is long."""
    if len(text) > most:
        text = f"{text[: 2 * most // 3]} ... {text[-most // 3 :]}"
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
