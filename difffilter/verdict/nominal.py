"""What a robust filter does to measurements that nothing is wrong with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from difffilter.comparison.held_out import HeldOut
from difffilter.filters.filter import Filter
from difffilter.filters.recipe import Recipe
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.scenario.scenario import Scenario
from difffilter.scenario.simulation import simulate
from difffilter.scoring.metrics import REJECTED

__all__ = ["Toll", "clean", "nominal_toll", "toll"]


@dataclass(frozen=True)
class Toll:
    """Mean weight, and the share of measurements with a weight below ``REJECTED``."""

    weight: float
    rejected: float


def toll(track: Track) -> Toll | None:
    """Of the present measurements of a track; None without records."""
    if track.record is None:
        return None
    weight = track.record.weight[track.record.present].double()
    return Toll(float(weight.mean()), float((weight < REJECTED).double().mean()))


def nominal_toll(filter: Recipe, values: Values, points: int = 20001) -> Toll | None:
    """For standard normal residuals: what weights and gate alone do, each channel by itself.

    None where channels share a weight, or are weighed by something else than their residual.
    """
    if not isinstance(filter, Filter):
        return None
    if filter.grouped is not None or filter.mad:
        return None
    constants = filter.prepare(values)
    share = (torch.arange(points, dtype=torch.float64) + 0.5) / points
    residual = torch.special.ndtri(share)
    weight = filter.weight(residual, constants)
    if filter.gate is not None:
        weight, _ = filter.gate.weigh(weight, residual.square(), None, constants, None)
    return Toll(float(weight.mean()), float((weight < REJECTED).double().mean()))


def clean(held: HeldOut, trajectories: int, seed: int) -> HeldOut | None:
    """The same scenario without faults, simulated; None for recordings."""
    if not isinstance(held.scenario, Scenario) or held.scenario.world is None:
        return None
    scenario = replace(held.scenario, faults={})
    return replace(held, scenario=scenario, log=simulate(scenario, trajectories, seed, "clean"))
