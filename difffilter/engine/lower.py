"""ATen operations on arrays of scalar expressions: every tensor becomes its entries."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from difffilter.engine.calls import Calls
from difffilter.engine.program import Program
from difffilter.engine.rules.table import Array, array
from difffilter.errors import DifffilterError, EngineError

__all__ = ["Array", "Lowering"]


class Lowering:
    """Turns torch operations into expressions, as they are called.

    Args:
        program: where the expressions go.
    """

    def __init__(self, program: Program) -> None:
        self.program = program

    def run(
        self, function: Callable[..., Sequence[torch.Tensor]], given: Sequence[tuple[Any, Array]]
    ) -> list[Array]:
        """Arrays of what a function of tensors returns.

        Args:
            given: tensors to call it with (shapes are all that counts), and their arrays.

        Raises:
            EngineError: names an operation that has no rule, and the line that calls it.
        """
        # Copies: one tensor in two places would be one input.
        tensors = [tensor.detach().clone() for tensor, _ in given]
        calls = Calls(self)
        for tensor, (_, nodes) in zip(tensors, given, strict=True):
            calls.bind(tensor, nodes)
        try:
            with torch.no_grad(), calls:
                found = function(*tensors)
                return [calls.array(tensor) for tensor in found]
        except DifffilterError:
            raise
        except Exception as error:  # whatever a user's model raises on samples
            said = (str(error).splitlines() or [""])[0]
            raise EngineError(f"engine: {type(error).__name__} while tracing: {said}") from error

    def constant(self, value: Any) -> Array:
        """Numbers as an array of constant nodes."""
        if isinstance(value, torch.Tensor):
            value = value.detach().to(torch.float64).numpy()
        numbers = np.asarray(value, dtype=float)
        return array(np.frompyfunc(self.program.const, 1, 1)(numbers))

    def of(self, value: Any) -> Array:
        """An array, made of a number where needed."""
        return value if isinstance(value, np.ndarray) else self.constant(value)

    def known(self, x: Any) -> Array | None:
        """The numbers of an array of constants; None if one is computed."""
        values = np.frompyfunc(self.program.value, 1, 1)(x)
        if any(v is None for v in np.ravel(values)):
            return None
        return np.asarray(values, dtype=float)

    def map(self, op: str, *args: Any) -> Array:
        """An operation on every entry, broadcasting."""
        made = np.frompyfunc(lambda *nodes: self.program.make(op, *nodes), len(args), 1)
        return array(made(*(self.of(a) for a in args)))

    def fold(self, op: str, x: Array, dims: Any, keepdim: bool) -> Array:
        """An operation from entry to entry along dimensions, in order."""
        axes = range(x.ndim) if dims is None else ([dims] if isinstance(dims, int) else dims)
        axes = sorted(a % max(x.ndim, 1) for a in axes) if x.ndim else []
        empty = {"mul": 1.0}.get(op, 0.0)
        for axis in reversed(axes):
            parts = np.moveaxis(x, axis, 0)
            total = (
                array(parts[0]) if len(parts) else self.constant(np.full(parts.shape[1:], empty))
            )
            for part in parts[1:]:
                total = self.map(op, total, array(part))
            x = np.expand_dims(array(total), axis) if keepdim else array(total)
        return x
