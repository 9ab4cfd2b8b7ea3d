"""Distributions of what is drawn in a simulated world, with their mean and variance."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from difffilter.scenario.table import Table

__all__ = ["Distribution", "read_distribution"]

KINDS = ("constant", "uniform", "normal")


@dataclass(frozen=True)
class Distribution:
    """Independent draws, one per axis or channel.

    Attributes:
        kind: ``constant`` (first), ``uniform`` (first = low, second = high) or ``normal``
            (first = mean, second = standard deviation).
        first, second: one number, or one per axis.
        two_sided: whether the sign is drawn too (plus or minus, equally likely).
    """

    kind: str
    first: tuple[float, ...]
    second: tuple[float, ...]
    two_sided: bool = False

    def sample(self, shape: tuple[int, ...], generator: Generator) -> Tensor:
        """Draws of the given shape; the last dimension is that of ``first``, or any for one."""
        first, second = self._tensors()
        if self.kind == "uniform":
            draw = first + (second - first) * torch.rand(
                shape, generator=generator, dtype=torch.float64
            )
        elif self.kind == "normal":
            draw = first + second * torch.randn(shape, generator=generator, dtype=torch.float64)
        else:
            draw = first.expand(shape)
        if self.two_sided:
            coin = torch.rand(shape, generator=generator, dtype=torch.float64)
            draw = torch.where(coin < 0.5, draw, -draw)
        return draw

    @property
    def mean(self) -> Tensor:
        """Expected value."""
        if self.two_sided:
            return torch.zeros(len(self.first), dtype=torch.float64)
        return self._plain_mean()

    @property
    def variance(self) -> Tensor:
        """Variance about the mean."""
        first, second = self._tensors()
        spread = {
            "constant": torch.zeros_like(first),
            "uniform": (second - first).square() / 12.0,
            "normal": second.square(),
        }[self.kind]
        return spread + self._plain_mean().square() if self.two_sided else spread

    def _plain_mean(self) -> Tensor:
        first, second = self._tensors()
        return (first + second) / 2.0 if self.kind == "uniform" else first

    def _tensors(self) -> tuple[Tensor, Tensor]:
        return (
            torch.tensor(self.first, dtype=torch.float64),
            torch.tensor(self.second, dtype=torch.float64),
        )


def read_distribution(table: Table, count: int | None, default: str | None = None) -> Distribution:
    """Read ``distribution`` and its numbers: value; low, high; or mean, sigma.

    Args:
        table: the table that holds them.
        count: length of a per-axis list that is accepted beside a single number.
        default: kind where the key is absent; None makes it compulsory.
    """
    kind = (
        table.text("distribution", default or "constant", choices=KINDS)
        if default
        else (table.text("distribution", choices=KINDS))
    )
    keys = {"constant": ("value",), "uniform": ("low", "high"), "normal": ("mean", "sigma")}[kind]
    read = [_numbers(table, key, count) for key in keys]
    length = max(len(numbers) for numbers in read)
    parts = [numbers * length if len(numbers) == 1 else numbers for numbers in read]
    first = parts[0]
    second = parts[1] if len(parts) > 1 else (0.0,) * length
    if kind == "uniform" and any(high < low for low, high in zip(first, second, strict=True)):
        table.fail("high", "numbers not below low")
    if kind == "normal" and min(second) < 0:
        table.fail("sigma", "a number of 0 or more")
    return Distribution(kind, first, second, table.flag("two_sided"))


def _numbers(table: Table, key: str, count: int | None) -> tuple[float, ...]:
    expected = "a number" if count is None else f"a number or a list of {count} numbers"
    value = table.nested(key)
    if isinstance(value, float):
        return (value,)
    if count is None or len(value) != count or not all(isinstance(v, float) for v in value):
        table.fail(key, expected)
    return tuple(value)
