"""The robust fit of first rows: coarse candidates refined, and what else they might mean."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.parameters.values import Constants
from difffilter.sensors.builtin import Position
from difffilter.sensors.information import Information, stacked_noise
from difffilter.sensors.sensor import Sensor
from difffilter.sensors.wrapped import bare
from difffilter.start.fit import Frame, Weigh, gauss_newton, linearised, residual
from difffilter.start.grid import candidates
from difffilter.start.rows import Epochs

__all__ = ["Found", "Problem", "search"]

REFINED = 8  # candidates per sensor
FINISHED = 4  # the best of them, and as many that lie apart
DOUBTFUL = 12.0  # ... where their cost is less than this above twice the best one
APART = 0.01  # of the candidates' extent

#: Another minimum counts if its cost is higher by less than this: e^3 = 20 to 1.
ODDS = 3.0
#: ... and if it lies farther away than this many standard deviations.
SIGMAS = 5.0
#: So many standard deviations away the cost must have risen by this share of what the
#: curvature promises that far: a valley, or a curvature that holds nearby alone, does not.
PROBES = (5.0, 15.0, 50.0)
RISE = 0.35
#: Share of the information that the weights, or the loss of one row, may take.
LEFT = 0.1
#: Rows from which on no direction may rest on a single one.
REDUNDANT = 5


class Found(NamedTuple):
    """The best fit of each of B trajectories, and what is doubtful about it.

    Attributes:
        unknown: (B, a), NaN where undetermined; factor: (B, a, a), covariance F F^T, grown by
            the mean square of the residuals that the weights leave where that is above 1.
        rival: (B, axes), another position of nearly the same cost; NaN where there is none.
        flat: (B,), whether the cost rises less than the curvature promises: other positions
            fit alike.
        contradicted: (B,), whether the weights took away nearly all that was known of some
            direction; alone: (B,), whether some direction rests on a single row.
    """

    unknown: Tensor
    factor: Tensor
    rival: Tensor
    flat: Tensor
    contradicted: Tensor
    alone: Tensor

    @property
    def undetermined(self) -> Tensor:
        """(B,)."""
        return torch.isnan(self.unknown).any(-1)

    @property
    def ambiguous(self) -> Tensor:
        """(B,), whether more rows must tell."""
        rival = ~torch.isnan(self.rival).any(-1)
        return self.undetermined | rival | self.flat | self.contradicted | self.alone


@dataclass(frozen=True)
class Problem:
    """First rows of B trajectories, and how the unknowns explain them.

    The cost is the sum of log(1 + |e / (scale sigma)|^2) over rows and channels (Cauchy); the
    channels of one position fix are one vector e: a wild fix is wild as a whole.
    """

    sensors: Sequence[Sensor]
    constants: Constants
    epochs: Epochs
    frame: Frame
    axes: int
    scale: float

    def select(self, at: Tensor) -> Problem:
        """Some of the trajectories."""
        frame = self.frame
        moved = {
            name: x[:, :, at] if x.dim() > own else x
            for name, x, own in (("along", frame.along, 2), ("offset", frame.offset, 1))
        }
        return replace(self, epochs=self.epochs.select(at), frame=frame._replace(**moved))

    @cached_property
    def z(self) -> Tensor:
        """(E, 1, B, m)."""
        return self.epochs.z.unsqueeze(1)

    @cached_property
    def inputs(self) -> Mapping[str, Tensor]:
        """Known inputs (E, 1, B, ...)."""
        return {name: value.unsqueeze(1) for name, value in self.epochs.inputs.items()}

    def sigma(self, state: Tensor) -> Tensor:
        """(..., m) of the channels at states (..., n)."""
        return stacked_noise(self.sensors, state, self.inputs, self.constants).total.sqrt()

    @cached_property
    def groups(self) -> Tensor:
        """(m, g), 1 where a channel belongs to a group."""
        blocks = [
            self.z.new_ones(len(s.channels), 1)
            if isinstance(bare(s), Position)
            else torch.eye(len(s.channels), dtype=self.z.dtype)
            for s in self.sensors
        ]
        return torch.block_diag(*blocks)  # type: ignore[no-untyped-call,no-any-return]

    def cost(self, unknown: Tensor) -> Tensor:
        """(C, B, a) -> (C, B); infinite where it is not a number."""
        state = self.frame.state(unknown)
        predicted = [s.predict(state, self.inputs, self.constants) for s in self.sensors]
        standard = residual(self.sensors, self.z, predicted) / (self.scale * self.sigma(state))
        total = torch.log1p(_square(standard) @ self.groups).sum((0, -1))
        total = total + (self.frame.information * unknown.square()).sum(-1) / self.scale**2
        return torch.where(torch.isnan(total), torch.inf, total)

    def narrow(self, standard: Tensor) -> Tensor:
        """Weights of the cost, from residuals in sigmas."""
        return self._weights(standard / self.scale)

    def wide(self, standard: Tensor) -> Tensor:
        """Weights at the candidate's own scale: far from the minimum, longer steps."""
        size = torch.where(torch.isnan(self.z), torch.nan, standard.abs())
        own = size.movedim(0, -1).flatten(-2).nanmedian(-1).values.nan_to_num(0.0)
        return self._weights(standard / own.unsqueeze(-1).clamp_min(self.scale))

    def _weights(self, standard: Tensor) -> Tensor:
        return (1.0 / (1.0 + _square(standard) @ self.groups)) @ self.groups.mT

    def refine(self, start: Tensor, weigh: Weigh, iterations: int) -> tuple[Tensor, Tensor, Tensor]:
        """Refined candidates (C, B, a), their factors and costs; without a fix, infinity."""
        fix = gauss_newton(
            self.sensors,
            self.constants,
            self.z,
            inputs=self.inputs,
            start=start,
            weigh=weigh,
            iterations=iterations,
            epochs=True,
            frame=self.frame,
        )
        return *fix, self.cost(fix.position)


def _square(x: Tensor) -> Tensor:
    """x^2, of what is too large to be squared the largest square: costs stay comparable."""
    largest = torch.finfo(x.dtype).max ** 0.49
    return x.clamp(-largest, largest).square()


def search(problem: Problem, iterations: int) -> Found:
    """The fit of lowest cost: a coarse grid per sensor, refined, and its rivals."""
    axes, unknowns = problem.axes, problem.frame.along.shape[-1]
    found = []
    epochs = problem.epochs
    for grid in candidates(problem.sensors, problem.constants, epochs.z, epochs.inputs, axes):
        grid = torch.nn.functional.pad(grid, (0, unknowns - axes))
        value = problem.cost(grid.flatten(0, 1)).reshape(grid.shape[:3])
        least, member = value.min(1)
        index = member[:, None, :, None].expand(-1, 1, -1, unknowns)
        found.append(_best(grid.gather(1, index).squeeze(1), least, REFINED))
    refined, _, value = problem.refine(torch.cat(found), problem.wide, iterations)
    unknown, factor, least = problem.refine(
        _best(refined, value, FINISHED), problem.narrow, 2 * iterations
    )
    apart, at_most = _apart(refined, value, axes)
    near = (at_most <= 2.0 * least.amin(0) + DOUBTFUL).any(0).nonzero().flatten()
    if len(near):
        kept = len(least)  # FINISHED, or fewer where the grid has no more
        more = problem.select(near).refine(apart[:, near], problem.narrow, 2 * iterations)
        unknown = torch.cat([unknown, apart])
        factor = torch.cat([factor, factor.new_zeros(len(apart), *factor.shape[1:])])
        least = torch.cat([least, least.new_full(apart.shape[:2], torch.inf)])
        for all_of, some in zip((unknown, factor, least), more, strict=True):
            all_of[kept:, near] = some
    value = least
    pick = value.argmin(0)
    row = torch.arange(len(pick))
    best, spread = unknown[pick, row], factor[pick, row]
    rival = _rival(unknown, factor, value, best, spread, axes)
    spread, contradicted, alone = _support(problem, best, spread)
    # With the spread that the residuals show: noise larger than declared is no valley.
    flat = _flat(problem, best, spread, value.amin(0))
    return Found(best, spread, rival, flat, contradicted, alone)


def _best(unknown: Tensor, value: Tensor, count: int) -> Tensor:
    """The ``count`` candidates (count, B, a) of lowest cost."""
    index = value.topk(min(count, len(value)), dim=0, largest=False, sorted=True).indices
    return unknown.gather(0, index.unsqueeze(-1).expand(-1, -1, unknown.shape[-1]))


def _apart(unknown: Tensor, value: Tensor, axes: int) -> tuple[Tensor, Tensor]:
    """Candidates of low cost away from better ones, (FINISHED, B, a), and their costs."""
    position = torch.nan_to_num(unknown[..., :axes])
    row = torch.arange(position.shape[1])
    extent = (position.amax(0) - position.amin(0)).norm(dim=-1)
    value, chosen, costs = value.clone(), [], []
    for _ in range(FINISHED + 1):
        pick = value.argmin(0)
        chosen.append(unknown[pick, row])
        costs.append(value[pick, row])
        near = (position - position[pick, row]).norm(dim=-1) <= APART * extent
        value = torch.where(near, torch.inf, value)
    return torch.stack(chosen[1:]), torch.stack(costs[1:])


def _rival(
    unknown: Tensor, factor: Tensor, value: Tensor, best: Tensor, spread: Tensor, axes: int
) -> Tensor:
    """The position of the best other minimum of nearly the same cost; NaN where none."""
    apart = unknown[..., :axes] - best[..., :axes]
    own = torch.nan_to_num((factor @ factor.mT + spread @ spread.mT)[..., :axes, :axes])
    size = own.diagonal(dim1=-2, dim2=-1).sum(-1)
    floor = (1e-12 * size + torch.finfo(size.dtype).tiny)[..., None, None]
    unit = torch.eye(axes, dtype=own.dtype)
    lower = torch.linalg.cholesky_ex(own + floor * unit).L
    white = torch.linalg.solve_triangular(lower, apart.unsqueeze(-1), upper=False).squeeze(-1)
    near = ~(white.square().sum(-1) > SIGMAS**2)
    value = torch.where(near | (value > value.amin(0) + ODDS), torch.inf, value)
    least, pick = value.min(0)
    other = unknown[pick, torch.arange(len(pick))][..., :axes]
    return torch.where(torch.isfinite(least).unsqueeze(-1), other, torch.nan)


def _flat(problem: Problem, best: Tensor, spread: Tensor, least: Tensor) -> Tensor:
    """(B,), whether the cost stays low along a principal axis of the claimed covariance."""
    axes, sizes, _ = torch.linalg.svd(torch.nan_to_num(spread))
    steps = (axes * sizes.unsqueeze(-2)).movedim(-1, 0)
    probes = torch.cat([sign * k * steps for k in PROBES for sign in (-1.0, 1.0)])
    rise = problem.cost(best + probes) - least
    return (rise < RISE * (PROBES[0] / problem.scale) ** 2).any(0)


def _support(problem: Problem, best: Tensor, spread: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The factor grown by the residuals; what the weights took; what one row alone carries."""
    known = ~torch.isnan(best).any(-1)
    unknown, factor = torch.nan_to_num(best).unsqueeze(0), torch.nan_to_num(spread)
    sensors, constants, z = problem.sensors, problem.constants, problem.z
    error, gradient = linearised(sensors, constants, z, problem.inputs, unknown, problem.frame)
    noise = stacked_noise(sensors, problem.frame.state(unknown), problem.inputs, constants)
    inverse = Information(noise.independent, noise.common, ~torch.isnan(z))
    weight = problem.narrow(error / noise.total.sqrt())
    columns = gradient @ factor  # in units where the fit's information is 1
    root = weight.sqrt().unsqueeze(-1)
    full = (columns.mT @ inverse.times(columns)).sum((0, 1))
    rows = ((root * columns).mT @ inverse.times(root * columns)).squeeze(1)
    prior = factor.mT @ torch.diag(problem.frame.information) @ factor
    contradicted = torch.linalg.eigvalsh(full + prior)[..., -1] > 1.0 / LEFT
    alone = torch.linalg.eigvalsh(rows)[..., -1].amax(0) > 1.0 - LEFT
    square = inverse.square(weight.sqrt() * error).sum((0, 1))
    counted = (weight * ~torch.isnan(z)).sum((0, 1, -1)).clamp_min(1.0)
    growth = (square / counted).clamp_min(1.0).sqrt()
    alone = alone & (problem.epochs.measured >= REDUNDANT)
    return growth[..., None, None] * spread, known & contradicted, known & alone
