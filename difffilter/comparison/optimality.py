"""FSP function and optimal filtering ratio (paper 2): how good a filter is, and could be.

delta(Y, b): the root mean square error of a filter with parameters b under the stimuli Y, over
time and runs, in each scene. xi = psi / delta, with psi the infimum of delta over the
parameters: the paper takes an ideal filter's; the tuned optimum is another choice.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product

import torch
from torch import Tensor
from tqdm import tqdm

from difffilter.errors import InputError
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log
from difffilter.parameters.parameters import Values
from difffilter.scenario.estimation import estimate, lean, started
from difffilter.scenario.scenario import Scenario
from difffilter.scoring.metrics import bootstrap_indices, scored_rows, squared_error

__all__ = ["FSP", "RatioGain", "fsp", "fsp_surface", "ratio_gain"]


@dataclass(frozen=True)
class FSP:
    """Mean squared errors of one filter, by scene and trajectory.

    Attributes:
        scenes: names; ``all`` where the scenario has none.
        squared: (S, B), m^2, mean over the scored rows of a scene.
    """

    scenes: tuple[str, ...]
    squared: Tensor

    @property
    def delta(self) -> Tensor:
        """(S,), m."""
        return self.squared.mean(-1).sqrt()

    def ratio(self, psi: FSP | Tensor) -> Tensor:
        """(S,), xi = psi / delta; psi from another filter on the same log, or (S,) in m."""
        best = psi.delta if isinstance(psi, FSP) else psi
        return best / self.delta


@torch.no_grad()
def fsp(
    scenario: Scenario, log: Log, system: str | None = None, values: Values | None = None
) -> FSP:
    """The FSP function of a system at given values, on a log with truth.

    Args:
        scenario: names the scenes and the rows that count.
        log: trajectories (T, B, m): the stimuli.
        system: by name; the one to tune if None.
        values: the published ones if missing.

    Raises:
        InputError: no truth; a scene without a scored row.
    """
    chosen = scenario.system(system)
    if isinstance(chosen, Recipe):
        chosen = lean(chosen, log.only(chosen.channels))
    track = estimate(chosen, started(scenario, chosen, log, values), values)
    rows = scored_rows(log, track, scenario.score)
    squared = torch.where(rows, squared_error(log, track, scenario.score), 0.0)
    scenes = [(scene.name, scene.first, scene.last) for scene in scenario.scenes]
    scenes = scenes or [("all", 1, log.steps)]
    made = []
    for name, first, last in scenes:
        count = rows[first - 1 : last].sum(0)
        if bool((count == 0).any()):
            raise InputError(f"scene {name}: found a trajectory without a scored row")
        made.append(squared[first - 1 : last].sum(0) / count)
    return FSP(tuple(name for name, _, _ in scenes), torch.stack(made).reshape(len(made), -1))


def fsp_surface(
    scenario: Scenario,
    log: Log,
    grid: Mapping[str, Sequence[float]],
    system: str | None = None,
    values: Values | None = None,
    progress: bool = False,
) -> Tensor:
    """delta over a grid of parameters: (G_1, ..., S), m.

    Args:
        grid: parameter name to values; an entry of a vector as ``igg3.k.k0``.
        values: of the other parameters.

    Raises:
        InputError: an unknown parameter, a value that it does not admit.
    """
    chosen = scenario.system(system)
    if not isinstance(chosen, Recipe):
        raise InputError("fsp: found a baseline, expected a filter with parameters")
    base = {**chosen.published(log.z.dtype), **dict(values or {})}
    entries = {
        entry: (name, i)
        for name, parameter in chosen.declarations.items()
        for i, entry in enumerate(parameter.entries())
    }
    for name in grid:
        if name not in entries:
            raise InputError(f"{name}: no such parameter, expected one of {', '.join(entries)}")
    points = list(product(*grid.values()))
    found = []
    for point in tqdm(points, desc="fsp", delay=2.0, disable=not progress):
        at = {name: value.clone() for name, value in base.items()}
        for entry, number in zip(grid, point, strict=True):
            name, i = entries[entry]
            at[name].reshape(-1)[i] = number
        found.append(fsp(scenario, log, system, at).delta)
    shape = [len(numbers) for numbers in grid.values()]
    return torch.stack(found).reshape(*shape, -1)


@dataclass(frozen=True)
class RatioGain:
    """Mean optimal filtering ratio of one filter relative to another's, minus 1.

    Attributes:
        gain: relative, 0.15 is 15 %; ci95: paired bootstrap interval over trajectories.
        per_scene: RMSE relative to the other's, minus 1, by scene.
    """

    gain: float
    ci95: tuple[float, float]
    per_scene: Mapping[str, float]


def ratio_gain(mine: FSP, other: FSP, psi: FSP, draws: int = 2000, seed: int = 0) -> RatioGain:
    """How much higher the mean ratio over scenes is than another filter's, on the same log.

    Args:
        mine: the filter that is judged, with B trajectories.
        other: what it is compared with, by the same trajectories and scenes.
        psi: stands for the infimum (paper 2: the ideal filter's).
        draws: of the bootstrap; seed: of these.
    """

    def mean_ratio(of: FSP, at: Tensor) -> Tensor:
        """(draws,), from resampled trajectories (draws, B)."""
        best, delta = (x.squared[:, at].mean(-1).sqrt() for x in (psi, of))
        return (best / delta).mean(0)

    every = torch.arange(mine.squared.shape[1])[None]
    at = bootstrap_indices(mine.squared.shape[1], draws, seed)
    gains = mean_ratio(mine, at) / mean_ratio(other, at) - 1.0
    low, high = torch.quantile(gains, gains.new_tensor([0.025, 0.975])).tolist()
    change = (mine.delta / other.delta - 1.0).tolist()
    return RatioGain(
        float(mean_ratio(mine, every) / mean_ratio(other, every) - 1.0),
        (low, high),
        dict(zip(mine.scenes, change, strict=True)),
    )
