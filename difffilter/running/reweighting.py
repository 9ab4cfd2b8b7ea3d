"""Robust smoothing: weights from the smoothed residuals, pass by pass.

Each pass runs the filter with every channel's noise variance divided by the weight of its
residual from the track of the pass before, and smooths. On a linear model a fixed point of it
is the M-estimate of the whole track: the minimum of the sum of rho(residual / sigma) and of
the squares of what the motion did (P. W. Holland and R. E. Welsch, 1977, eq. (4), here over
all rows [reconstruction]).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from difffilter.adaptation.passive import Memory, Passive
from difffilter.core.linearised import Linearised
from difffilter.errors import InputError
from difffilter.filters.filter import Filter
from difffilter.logs.log import Log
from difffilter.logs.track import Track
from difffilter.parameters.values import Constants
from difffilter.weights.registry import plain

__all__ = ["GIVEN", "check_weighs", "told", "weights_of"]

#: Input (T, ..., m): the weight of each channel.
GIVEN = "given.weight"


@dataclass(frozen=True)
class GivenWeights(Passive):
    """Noise variances divided by the log's input ``given.weight``, all above 0."""

    def before_condition(
        self,
        memory: Memory,
        linearised: Linearised,
        present: Tensor,
        inputs: Mapping[str, Tensor],
        constants: Constants,
    ) -> tuple[Linearised, Memory]:
        """The step with the noise that its weights leave."""
        weight = inputs[GIVEN]
        independent = linearised.independent / weight
        total = linearised.total + (independent - linearised.independent)
        return linearised._replace(independent=independent, total=total), memory


def check_weighs(filter: Filter, passes: int) -> None:
    """InputError for passes that are none, or a filter that weighs in another way."""
    found = ""
    if passes < 0:
        raise InputError(f"passes: found {passes}, expected 0 or more")
    if not passes:
        return
    if filter.adaptation is not None:
        found = "an adaptation"
    elif filter.weigh_prior:
        found = "weigh_prior"
    elif filter.grouped is not None:
        found = f"weights of scope {filter.scope}"
    elif filter.weight == plain:
        found = "a filter whose weight is plain"
    if found:
        raise InputError(f"passes: found {found}, expected a weight of each channel by itself")


def told(filter: Filter, log: Log, weight: Tensor) -> tuple[Filter, Log]:
    """The filter that takes weights as given, and the log with them; weight 0 is missing."""
    given = torch.where(weight > 0.0, weight, 1.0)
    missing = torch.where(weight > 0.0, log.z, torch.nan)
    own = dict(filter.overrides)
    recipe = replace(
        filter,
        weight=plain,
        gate=None,
        recovery=None,
        iterations=0,
        mad=False,
        adaptation=GivenWeights(),
        overrides={},
    )
    recipe = replace(recipe, overrides={n: p for n, p in own.items() if n in recipe.declarations})
    return recipe, replace(log, z=missing, inputs={**log.inputs, GIVEN: given})


def weights_of(filter: Filter, constants: Constants, log: Log, track: Track) -> Tensor:
    """(T, ..., m), weights of the residuals in sigmas of the noise; 0 where missing."""
    parts = []
    at = 0
    for sensor in filter.sensors:
        z = log.z[..., at : (at := at + len(sensor.channels))]
        value = sensor.predict(track.mean, log.inputs, constants)
        total = sensor.noise(track.mean, log.inputs, constants).total
        residual = sensor.residual(torch.where(torch.isnan(z), value, z), value)
        weight = filter.weight(residual * total.rsqrt(), constants, constants.get("temperature"))
        parts.append(torch.where(torch.isnan(z), 0.0, weight))
    return torch.cat(parts, dim=-1)
