"""Maps between physical values and the unconstrained numbers that optimisers see."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from difffilter.errors import InputError

__all__ = [
    "Above",
    "Below",
    "Bounded",
    "Constraint",
    "Covariance",
    "Interval",
    "OrderedPair",
    "Positive",
    "Real",
    "Simplex",
]

#: Smallest eigenvalue that the correlations of a tuned covariance can have.
FLOOR = 1e-9


@dataclass(frozen=True)
class Constraint:
    """Set of admissible values. Subclasses give the two maps and the membership test."""

    def physical(self, free: Tensor) -> Tensor:
        """Map unconstrained numbers to an admissible value."""
        raise NotImplementedError

    def free(self, physical: Tensor) -> Tensor:
        """Inverse of :meth:`physical`."""
        raise NotImplementedError

    def expected(self) -> str:
        """What an admissible value is, for messages."""
        raise NotImplementedError

    def admits(self, physical: Tensor) -> bool:
        """Whether the value lies in the set (all entries finite as well)."""
        return bool(torch.isfinite(physical).all()) and self._admits(physical)

    def _admits(self, physical: Tensor) -> bool:
        raise NotImplementedError


@dataclass(frozen=True)
class Real(Constraint):
    """Any finite number; ``scale`` is what the optimiser counts as one unit."""

    scale: float = 1.0

    def physical(self, free: Tensor) -> Tensor:
        return self.scale * free

    def free(self, physical: Tensor) -> Tensor:
        return physical / self.scale

    def expected(self) -> str:
        return "a finite number"

    def _admits(self, physical: Tensor) -> bool:
        return True


@dataclass(frozen=True)
class Positive(Constraint):
    """Above zero, through the exponential: steps are relative, scales stay scales.

    Attributes:
        zero: entries of a vector that are known: exactly 0, and never tuned.
    """

    zero: tuple[int, ...] = ()

    def physical(self, free: Tensor) -> Tensor:
        value = free.exp()
        if not self.zero:
            return value
        size = value.shape[-1] + len(self.zero)
        return value.new_zeros(size).index_put((self._kept(size),), value)

    def free(self, physical: Tensor) -> Tensor:
        if not self.zero:
            return physical.log()
        return physical[self._kept(physical.shape[-1])].log()

    def expected(self) -> str:
        if not self.zero:
            return "a number above 0"
        return f"numbers above 0, and 0 at {', '.join(str(i + 1) for i in self.zero)}"

    def _admits(self, physical: Tensor) -> bool:
        if not self.zero:
            return bool((physical > 0).all())
        size = physical.shape[-1]
        return bool((physical[self._kept(size)] > 0).all() and (physical[[*self.zero]] == 0).all())

    def _kept(self, size: int) -> Tensor:
        return torch.tensor([i for i in range(size) if i not in self.zero], dtype=torch.long)


@dataclass(frozen=True)
class Above(Constraint):
    """Above a bound, through low + exp."""

    low: float

    def physical(self, free: Tensor) -> Tensor:
        return self.low + free.exp()

    def free(self, physical: Tensor) -> Tensor:
        return (physical - self.low).log()

    def expected(self) -> str:
        return f"a number above {self.low:g}"

    def _admits(self, physical: Tensor) -> bool:
        return bool((physical > self.low).all())


@dataclass(frozen=True)
class Below(Constraint):
    """Below a bound, through high - exp."""

    high: float

    def physical(self, free: Tensor) -> Tensor:
        return self.high - free.exp()

    def free(self, physical: Tensor) -> Tensor:
        return (self.high - physical).log()

    def expected(self) -> str:
        return f"a number below {self.high:g}"

    def _admits(self, physical: Tensor) -> bool:
        return bool((physical < self.high).all())


@dataclass(frozen=True)
class Interval(Constraint):
    """Strictly between two bounds, through the logistic function."""

    low: float = 0.0
    high: float = 1.0

    def physical(self, free: Tensor) -> Tensor:
        return self.low + (self.high - self.low) * torch.sigmoid(free)

    def free(self, physical: Tensor) -> Tensor:
        return torch.logit((physical - self.low) / (self.high - self.low))

    def expected(self) -> str:
        return f"a number between {self.low:g} and {self.high:g}"

    def _admits(self, physical: Tensor) -> bool:
        return bool(((physical > self.low) & (physical < self.high)).all())


@dataclass(frozen=True)
class Bounded(Constraint):
    """Between two bounds, both admitted: a published 0 can be tuned, and tuned to 0.

    The map clips; its gradient is that of the unclipped number, so that a value on a bound
    can leave it again. ``scale`` is what the optimiser counts as one unit.
    """

    low: float = 0.0
    high: float = math.inf
    scale: float = 1.0

    def physical(self, free: Tensor) -> Tensor:
        value = self.scale * free
        return value + (value.clamp(self.low, self.high) - value).detach()

    def free(self, physical: Tensor) -> Tensor:
        return physical / self.scale

    def expected(self) -> str:
        if self.high == math.inf:
            return f"a number of {self.low:g} or more"
        return f"a number from {self.low:g} to {self.high:g}"

    def _admits(self, physical: Tensor) -> bool:
        return bool(((physical >= self.low) & (physical <= self.high)).all())


@dataclass(frozen=True)
class OrderedPair(Constraint):
    """Two numbers 0 < a < b (clipping points), through log a and log(b - a)."""

    def physical(self, free: Tensor) -> Tensor:
        return free.exp().cumsum(-1)

    def free(self, physical: Tensor) -> Tensor:
        first, second = physical[..., 0], physical[..., 1]
        return torch.stack([first.log(), (second - first).log()], dim=-1)

    def expected(self) -> str:
        return "two numbers [a, b] with 0 < a < b"

    def _admits(self, physical: Tensor) -> bool:
        if physical.shape != (2,):
            return False
        return bool((physical[0] > 0) & (physical[1] > physical[0]))


@dataclass(frozen=True)
class Simplex(Constraint):
    """Positive numbers that sum to 1, through log ratios to the last one."""

    def physical(self, free: Tensor) -> Tensor:
        return torch.softmax(torch.nn.functional.pad(free, (0, 1)), dim=-1)

    def free(self, physical: Tensor) -> Tensor:
        return (physical[..., :-1] / physical[..., -1:]).log()

    def expected(self) -> str:
        return "two or more positive numbers that sum to 1"

    def _admits(self, physical: Tensor) -> bool:
        if physical.dim() != 1 or physical.shape[0] < 2:
            return False
        return bool((physical > 0).all()) and bool(
            (physical.sum() - 1.0).abs() < max(1e-9, 8 * torch.finfo(physical.dtype).eps)
        )


def _floor(dtype: torch.dtype) -> float:
    """Share of independent noise in every tuned covariance."""
    return max(FLOOR, 64.0 * torch.finfo(dtype).eps)


@dataclass(frozen=True)
class Covariance(Constraint):
    """Symmetric positive definite matrix P = D C D: standard deviations D, correlations C.

    The free numbers are the entries of a lower triangle, row by row. Those of the diagonal are
    the logarithms of the standard deviations. The others are l_ij / l_ii of the Cholesky factor
    L of P: row i of the factor of C is (l_i1, ..., l_i,i-1, 1) / its length. So steps are
    relative, in whatever units, and standard deviations are free of correlations
    [reconstruction]. C is that matrix times 1 - e, plus e times the identity, e = 1e-9 (more
    in float32): positive definite to the precision after a step of any size.

    Raises:
        InputError: correlations of 1 to within e, where free numbers are asked for.
    """

    def physical(self, free: Tensor) -> Tensor:
        n = (math.isqrt(8 * free.shape[-1] + 1) - 1) // 2
        rows, cols = torch.tril_indices(n, n)
        lower = free.new_zeros(n, n).index_put((rows, cols), free)
        sigma = lower.diagonal(dim1=-2, dim2=-1).exp()
        identity = torch.eye(n, dtype=free.dtype, device=free.device)
        unit = lower.tril(-1) + identity
        unit = unit * unit.square().sum(-1, keepdim=True).rsqrt()
        floor = _floor(free.dtype)
        correlations = (1.0 - floor) * (unit @ unit.mT) + floor * identity
        return correlations * (sigma.unsqueeze(-1) * sigma.unsqueeze(-2))

    def free(self, physical: Tensor) -> Tensor:
        sigma = physical.diagonal(dim1=-2, dim2=-1).sqrt()
        floor = _floor(physical.dtype)
        correlations = physical / (sigma.unsqueeze(-1) * sigma.unsqueeze(-2))
        identity = torch.eye(physical.shape[-1], dtype=physical.dtype, device=physical.device)
        lower, failed = torch.linalg.cholesky_ex((correlations - floor * identity) / (1.0 - floor))
        if bool(failed.any()):
            raise InputError(
                f"covariance: found correlations of 1 to within {floor:.0e}, expected such that "
                "each number has an error of its own"
            )
        unit: Tensor = (lower / lower.diagonal(dim1=-2, dim2=-1).unsqueeze(-1)).tril(-1)
        rows, cols = torch.tril_indices(*physical.shape[-2:])
        return (unit + torch.diag_embed(sigma.log()))[..., rows, cols]

    def expected(self) -> str:
        return "a symmetric positive definite matrix"

    def _admits(self, physical: Tensor) -> bool:
        if physical.dim() != 2 or physical.shape[0] != physical.shape[1]:
            return False
        symmetric = torch.allclose(physical, physical.mT, rtol=1e-9, atol=0.0)
        return symmetric and bool(torch.linalg.cholesky_ex(physical).info == 0)
