"""Several adaptations, one after the other."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.adaptation.passive import Memory
from difffilter.adaptation.protocol import Adaptation
from difffilter.core.equations import Conditioned
from difffilter.core.linearised import Linearised
from difffilter.errors import InputError
from difffilter.parameters.parameters import Parameter
from difffilter.parameters.values import Constants

__all__ = ["Chain"]


@dataclass(frozen=True)
class Chain:
    """Each hook of each part in order: the second sees what the first has made.

    Attributes:
        parts: adaptations whose memories have different names.

    Raises:
        InputError: two parts that keep the same memory.
    """

    parts: tuple[Adaptation, ...]

    def __post_init__(self) -> None:
        seen: set[str] = set()
        for part in self.parts:
            names = set(part.memory(torch.zeros(1), 1))
            if names & seen:
                raise InputError(
                    f"adaptation: found two that keep {min(names & seen)}, expected one"
                )
            seen |= names

    @property
    def parameters(self) -> tuple[Parameter, ...]:
        """Those of all parts."""
        return tuple(p for part in self.parts for p in part.parameters)

    @property
    def ideal(self) -> bool:
        """Whether a part needs what only a simulation knows."""
        return any(getattr(part, "ideal", False) for part in self.parts)

    @property
    def independent_noise(self) -> bool:
        """Whether a part needs channels of independent noise."""
        return any(getattr(part, "independent_noise", False) for part in self.parts)

    @property
    def rescales(self) -> bool:
        """Whether a part scales each state's past by a number of its own."""
        return any(getattr(part, "rescales", False) for part in self.parts)

    def memory(self, mean: Tensor, channels: int) -> dict[str, Tensor]:
        """Those of all parts."""
        return {k: v for part in self.parts for k, v in part.memory(mean, channels).items()}

    def before_predict(
        self, memory: Memory, process: Tensor, inputs: Memory, constants: Constants
    ) -> Tensor:
        """Process noise through all parts."""
        for part in self.parts:
            process = part.before_predict(memory, process, inputs, constants)
        return process

    def before_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        present: Tensor,
        inputs: Memory,
        constants: Constants,
    ) -> tuple[Linearised, Memory]:
        """The linearised step through all parts."""
        for part in self.parts:
            linearised, new = part.before_condition(memory, linearised, present, inputs, constants)
            memory = {**memory, **new}
        return linearised, memory

    def after_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        conditioned: Conditioned,
        weight: Tensor,
        present: Tensor,
        constants: Constants,
    ) -> Memory:
        """Memory of all parts."""
        for part in self.parts:
            new = part.after_condition(memory, linearised, conditioned, weight, present, constants)
            memory = {**memory, **new}
        return memory
