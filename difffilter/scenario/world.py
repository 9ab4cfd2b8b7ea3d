"""The simulated truth: how the target really moves."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from difffilter.motions.blocks import AXES
from difffilter.scenario.distribution import Distribution, read_distribution
from difffilter.scenario.table import Table

__all__ = ["Jump", "Platform", "Segment", "World", "read_world"]


#: s, of a time step: 30 years.
LONGEST = 1e9


@dataclass(frozen=True)
class Segment:
    """A stretch of the truth, for steps first < k <= last.

    Attributes:
        acceleration: m/s^2 per axis, added to the random one.
        turn_rate: rad/s of a coordinated turn (two axes, positive from x to y).
    """

    first: int
    last: int
    acceleration: tuple[float, ...]
    turn_rate: float


@dataclass(frozen=True)
class Jump:
    """Sudden change of the state after step ``step`` (its position shows it one step later)."""

    step: int
    position: tuple[float, ...]
    velocity: tuple[float, ...]


@dataclass(frozen=True)
class Platform:
    """A moving platform that carries sensors; known: inputs ``platform_x``, ``platform_y``...

    It moves like the target, without anything random.
    """

    position: tuple[float, ...]
    velocity: tuple[float, ...]
    segments: tuple[Segment, ...]


@dataclass(frozen=True)
class World:
    """Truth of a scenario, in SI units.

    The state is position, then velocity. Each step::

        position += velocity dt + a dt^2 / 2,   velocity += a dt

    with a the segment's acceleration plus a random one drawn at every step, or the exact
    coordinated turn; then Gaussian ``disturbance`` on every state.
    """

    axes: int
    dt: float
    steps: int
    position: tuple[float, ...]
    velocity: tuple[float, ...]
    acceleration: Distribution
    disturbance: tuple[float, ...]
    segments: tuple[Segment, ...]
    jumps: tuple[Jump, ...]
    platform: Platform | None = None
    ideal_process: tuple[tuple[int, int, float], ...] = ()

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the true states."""
        names = AXES[: self.axes]
        return (*names, *(f"v{name}" for name in names))

    def simulate(self, trajectories: int, generator: Generator) -> Tensor:
        """Truth at steps 0..steps: (steps + 1, trajectories, 2 axes)."""
        n, dt = self.axes, self.dt
        shape = (self.steps, trajectories, n)
        pushes = self.acceleration.sample(shape, generator)
        noise = torch.tensor(self.disturbance, dtype=torch.float64) * torch.randn(
            (self.steps, trajectories, 2 * n), generator=generator, dtype=torch.float64
        )
        state = torch.tensor((*self.position, *self.velocity), dtype=torch.float64)
        state = state.expand(trajectories, 2 * n)
        path = [state]
        for k in range(1, self.steps + 1):
            position, velocity = _move(
                state[:, :n], state[:, n:], pushes[k - 1], self.segments, k, dt
            )
            for jump in self.jumps:
                if jump.step == k:
                    position = position + torch.tensor(jump.position, dtype=torch.float64)
                    velocity = velocity + torch.tensor(jump.velocity, dtype=torch.float64)
            state = torch.cat([position, velocity], dim=-1) + noise[k - 1]
            path.append(state)
        return torch.stack(path)

    @property
    def platform_inputs(self) -> tuple[str, ...]:
        """Names of the inputs with the platform's position; empty without one."""
        return tuple(f"platform_{axis}" for axis in AXES[: self.axes]) if self.platform else ()

    def process_levels(self) -> Tensor:
        """(steps,), process noise that an ideal filter assumes; NaN where its own."""
        levels = torch.full((self.steps,), math.nan, dtype=torch.float64)
        for first, last, level in self.ideal_process:
            levels[first - 1 : last] = level
        return levels

    def platform_path(self) -> Tensor:
        """Position of the platform at steps 1..steps: (steps, axes)."""
        assert self.platform is not None
        position = torch.tensor([self.platform.position], dtype=torch.float64)
        velocity = torch.tensor([self.platform.velocity], dtype=torch.float64)
        still, path = torch.zeros_like(position), []
        for k in range(1, self.steps + 1):
            position, velocity = _move(
                position, velocity, still, self.platform.segments, k, self.dt
            )
            path.append(position[0])
        return torch.stack(path)


def _move(
    position: Tensor,
    velocity: Tensor,
    push: Tensor,
    segments: tuple[Segment, ...],
    step: int,
    dt: float,
) -> tuple[Tensor, Tensor]:
    """One step with the acceleration ``push`` and what the segments add."""
    rate = 0.0
    for segment in segments:
        if segment.first < step <= segment.last:
            push = push + torch.tensor(segment.acceleration, dtype=torch.float64)
            rate += segment.turn_rate
    moved, turned = _turn(velocity, rate, dt)
    return position + moved + 0.5 * (dt * dt) * push, turned + dt * push


def _turn(velocity: Tensor, rate: float, dt: float) -> tuple[Tensor, Tensor]:
    """Displacement and new velocity of a coordinated turn; straight ahead at rate 0."""
    if rate == 0.0:
        return dt * velocity, velocity
    sine, cosine = math.sin(rate * dt), math.cos(rate * dt)
    x, y = velocity[:, 0], velocity[:, 1]
    moved = torch.stack(
        [(sine * x - (1 - cosine) * y) / rate, ((1 - cosine) * x + sine * y) / rate], dim=-1
    )
    return moved, torch.stack([cosine * x - sine * y, sine * x + cosine * y], dim=-1)


def read_world(table: Table) -> World:
    """Read ``[world]``."""
    axes = table.integer("axes", 2, low=1)
    if axes > len(AXES):
        table.fail("axes", f"a whole number from 1 to {len(AXES)}")
    steps = table.integer("steps", low=1)
    zeros = (0.0,) * axes
    push = table.table("acceleration", optional=True)
    if push.data:
        acceleration = read_distribution(push, axes)
    else:
        acceleration = Distribution("constant", (0.0,), (0.0,))
    push.finish()
    jumps = []
    for part in table.tables("jumps"):
        jumps.append(
            Jump(
                part.integer("step", low=1),
                part.numbers("position", axes, zeros),
                part.numbers("velocity", axes, zeros),
            )
        )
        part.finish()
    disturbance = table.numbers("disturbance", 2 * axes, (0.0,) * (2 * axes))
    if min(disturbance) < 0:
        table.fail("disturbance", "standard deviations of 0 or more")
    world = World(
        axes=axes,
        dt=table.number("dt", above=0.0, high=LONGEST),
        steps=steps,
        position=table.numbers("position", axes),
        velocity=table.numbers("velocity", axes),
        acceleration=acceleration,
        disturbance=disturbance,
        segments=_read_segments(table, axes),
        jumps=tuple(jumps),
        platform=_read_platform(table, axes),
        ideal_process=_read_ideal(table),
    )
    table.finish()
    return world


def _read_segments(table: Table, axes: int) -> tuple[Segment, ...]:
    segments = []
    for part in table.tables("segments"):
        rate = part.number("turn_rate_deg", 0.0)
        if rate and axes != 2:
            part.fail("turn_rate_deg", "no turn in a world without two axes")
        segment = Segment(
            part.integer("first"),
            part.integer("last"),
            part.numbers("acceleration", axes, (0.0,) * axes),
            math.radians(rate),
        )
        if segment.last <= segment.first:
            part.fail("last", f"a step after first = {segment.first}")
        segments.append(segment)
        part.finish()
    return tuple(segments)


def _read_platform(table: Table, axes: int) -> Platform | None:
    if "platform" not in table:
        return None
    part = table.table("platform")
    platform = Platform(
        part.numbers("position", axes),
        part.numbers("velocity", axes),
        _read_segments(part, axes),
    )
    part.finish()
    return platform


def _read_ideal(table: Table) -> tuple[tuple[int, int, float], ...]:
    levels = []
    for part in table.tables("ideal_process"):
        first, last = part.integer("first", low=1), part.integer("last", low=1)
        if last < first:
            part.fail("last", f"a step of first = {first} or later")
        levels.append((first, last, part.number("acceleration", above=0.0)))
        part.finish()
    return tuple(levels)
