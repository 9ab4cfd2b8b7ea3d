"""Simulated logs of a scenario's world."""

from __future__ import annotations

import torch

from difffilter.errors import InputError, shown
from difffilter.logs.log import Log, Start
from difffilter.scenario.case import Case
from difffilter.scenario.model import Model
from difffilter.scenario.pooling import pooled
from difffilter.scenario.scenario import Scenario
from difffilter.scenario.table import LARGEST
from difffilter.seeds import stream

__all__ = ["simulate"]


def simulate(scenario: Case, trajectories: int = 100, seed: int = 0, purpose: str = "log") -> Log:
    """Draw trajectories, measurements, faults and starts.

    Row k of the log (from 0) is step k + 1 of the world, at time (k + 1) dt: the prescribed
    start is at time 0 and has no measurement.

    Args:
        scenario: with a world, or a model with ``simulate``.
        trajectories: how many, B.
        seed, purpose: the same pair gives the same log; different purposes are disjoint.

    Returns:
        Log with z (T, B, m), truth (T, B, 2 axes), the prescribed start where the scenario
        starts from the truth, the platform's position (inputs ``platform_x``...) where there
        is one, and what filters that are no filters to deploy are told: clairvoyant ones
        ``fault.mean`` and ``fault.variance``, ideal ones the true error and noise variance
        of each channel, ``ideal.error`` and ``ideal.variance``, and ``ideal.process``.

    Raises:
        InputError: a scenario of recorded logs, or trajectories below 1.

    Example:
        >>> from difffilter import load_scenario, simulate
        >>> simulate(load_scenario("airport-mlat"), trajectories=3, seed=7).z.shape
        torch.Size([100, 3, 7])
    """
    if trajectories < 1:
        raise InputError(f"trajectories: found {trajectories}, expected 1 or more")
    if trajectories > LARGEST:
        raise InputError(f"trajectories: found {shown(trajectories)}, expected {LARGEST} at most")
    if isinstance(scenario, Model):
        return scenario.simulated(trajectories, seed, purpose)
    assert isinstance(scenario, Scenario)
    world = scenario.world
    if world is None:
        raise InputError(f"{scenario.name}: has no [world] to simulate, expected recorded logs")
    path = world.simulate(trajectories, stream(seed, purpose, "truth"))
    truth = path[1:]
    inputs = {}
    if world.platform is not None:
        known = world.platform_path().unsqueeze(1).expand(-1, trajectories, -1)
        inputs = dict(zip(world.platform_inputs, known.unbind(-1), strict=True))
    z, told = _measure(scenario, truth, inputs, seed, purpose)
    return Log(
        channels=scenario.channels,
        time=world.dt * torch.arange(1, world.steps + 1, dtype=torch.float64),
        z=z,
        truth=truth,
        truth_states=world.states,
        inputs=inputs
        | told
        | {"ideal.process": world.process_levels().unsqueeze(-1).expand(-1, trajectories)},
        start=_start(scenario, path[0], seed, purpose),
        names=tuple(f"{scenario.name}-{seed}-{i}" for i in range(trajectories)),
    )


def _measure(
    scenario: Scenario,
    truth: torch.Tensor,
    inputs: dict[str, torch.Tensor],
    seed: int,
    purpose: str,
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Measurements (T, B, m), noise and faults in them, and what clairvoyant filters are told."""
    made = [
        sensor.measure(truth, stream(seed, purpose, "noise", name), inputs)
        for name, sensor in scenario.sensors.items()
    ]
    z, exact, noise = (torch.cat(parts, dim=-1) for parts in zip(*made, strict=True))
    if not bool(torch.isfinite(truth).all() and torch.isfinite(exact).all()):
        raise InputError(
            f"{scenario.name}: world: found a truth or a measurement that is not finite, expected "
            "moderate positions, velocities, accelerations and times"
        )
    mean, variance = torch.zeros_like(z), torch.zeros_like(z)
    # Dropouts last: what is missing stays missing.
    for name, fault in sorted(scenario.faults.items(), key=lambda item: item[1].kind == "dropout"):
        generator = stream(seed, purpose, "fault", name)
        z, added_mean, added_variance = fault.strike(z, scenario.channels, generator)
        mean, variance = mean + added_mean, variance + added_variance
    z, weights = pooled(scenario.sensors, scenario.channels, z)
    return z, {
        "fault.mean": _shared(mean, weights),
        "fault.variance": _shared(variance, weights.square()),
        "ideal.error": torch.nan_to_num(z - exact),
        "ideal.variance": noise,
    }


def _start(scenario: Scenario, state: torch.Tensor, seed: int, purpose: str) -> Start | None:
    """Truth plus normal errors, or None where the scenario starts from measurements."""
    if scenario.start.kind != "truth":
        return None
    axes = scenario.axes
    sigma = [scenario.start.position_sigma] * axes + [scenario.start.velocity_sigma] * axes
    noise = torch.randn(state.shape, generator=stream(seed, purpose, "start"), dtype=torch.float64)
    return Start(state + torch.tensor(sigma, dtype=torch.float64) * noise, None, 0.0)


def _shared(x: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Weighted sums over channels (..., m); an infinite entry counts only where it has weight."""
    parts = torch.where(weights > 0.0, x.unsqueeze(-2) * weights, 0.0)
    return parts.sum(-1)
