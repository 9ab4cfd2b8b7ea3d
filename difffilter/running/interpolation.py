"""Hidden measurements asked of the smoother: what the rows before and after foretell of them."""

from __future__ import annotations

from dataclasses import replace

import torch

from difffilter.core.beliefs import Belief, Measurement, Record
from difffilter.errors import InputError
from difffilter.filters.hiding import HIDDEN
from difffilter.filters.prediction import Predicted, linearise
from difffilter.filters.recipe import Recipe
from difffilter.logs.log import Log, Start
from difffilter.logs.track import Track
from difffilter.parameters.parameters import Values
from difffilter.running.batch import prepared
from difffilter.running.smoothing import check_smoothable, smooth

__all__ = ["interpolated"]


def interpolated(
    recipe: Recipe,
    log: Log,
    values: Values | None = None,
    start: Start | Belief | None = None,
    *,
    temperature: float | None = None,
    engine: str = "auto",
) -> Track:
    """Smoothed estimates without what the log's input ``hidden`` hides, and the record of that.

    The innovation of a hidden measurement is its distance from the smoothed estimate, with the
    nominal variance H P_s H^T + R: it had no part in either. Arguments, errors and gradient as
    for :func:`difffilter.smooth`.
    """
    filter = check_smoothable(recipe)
    if HIDDEN not in log.inputs:
        raise InputError(f"log: found no input {HIDDEN}, expected which measurements are")
    hidden = log.inputs[HIDDEN] > 0.5
    given = replace(log, z=torch.where(hidden, torch.nan, log.z))
    track = smooth(filter, given, values, start, temperature=temperature, engine=engine)
    constants, _, intervals = prepared(filter, log, values, start, temperature)
    mean, deviations = track.mean, track.deviations
    none = torch.zeros_like(deviations[..., :0])
    at = Predicted(mean, deviations, deviations, none, lambda columns: columns)
    lead = log.z.shape[:-1]
    dt = intervals.reshape(*intervals.shape, *[1] * (len(lead) - intervals.dim())).expand(lead)
    row = Measurement(torch.where(hidden, log.z, torch.nan), dt, log.inputs)
    told, present = linearise(filter, constants, at, row)
    sigma = told.innovation_variance.sqrt()
    count = present.to(sigma.dtype)
    record = Record(
        innovation=told.innovation,
        observed=told.observed,
        noise=told.independent,
        standardised=told.innovation / sigma,
        weight=count,
        prior_weight=torch.ones_like(mean[..., : deviations.shape[-2]]),
        gate=torch.ones_like(count),
        modes=mean[..., :0],
        present=present,
        isolated=torch.zeros_like(present),
    )
    return replace(track, record=record)
