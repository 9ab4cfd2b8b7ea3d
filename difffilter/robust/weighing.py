"""Weigh and condition: once from the innovation, or iteratively from residuals (M-EKF)."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from difffilter.core.beliefs import Record
from difffilter.core.conditioning import condition
from difffilter.core.equations import Conditioned
from difffilter.core.linalg import positive_sqrt, square_norms
from difffilter.core.linearised import Linearised
from difffilter.filters.filter import Filter
from difffilter.parameters.parameters import Values
from difffilter.robust.groups import group_rms, normalised_square, spread

__all__ = ["reweigh", "weigh_once"]


def weigh_once(
    filter: Filter,
    constants: Values,
    linear: Linearised,
    present: Tensor,
    widening: Tensor | None = None,
) -> tuple[Conditioned, Record]:
    """Weights from the nominal innovation, one conditioning.

    ``widening`` (...) divides every NIS that gate and weight see (see ``recovery``).
    """
    scales = _scales(filter, linear, widening)
    s = _distance(filter, linear, linear.innovation, present, scales)
    weight = filter.weight(s, constants, constants.get("temperature"))
    test = _test(filter, linear, present, scales)
    weight, gate = _gated(filter, constants, weight, test)
    weight = weight * present
    conditioned = _condition(filter, constants, linear, linear.deviations, linear.observed, weight)
    prior_weight = torch.ones_like(linear.deviations[..., : len(filter.motion.tangent), 0])
    return conditioned, _record(linear, s, weight, prior_weight, gate, present)


def reweigh(
    filter: Filter,
    constants: Values,
    linear: Linearised,
    present: Tensor,
    widening: Tensor | None = None,
) -> tuple[Conditioned, Record]:
    """M-EKF: iteratively reweighted regression of [prediction; measurement].

    Paper 3, eqs. (15)-(27). Weighing the prediction scales the columns of the deviations
    by 1/sqrt(w_x); the shift of identity rows is minus the whitened prior residual, so that
    no system is solved.
    """
    n = len(filter.motion.tangent)
    weight = present.to(linear.mean.dtype)
    gate = torch.ones_like(weight)
    prior_weight = torch.ones_like(linear.deviations[..., :n, 0])
    s = linear.innovation
    temperature = constants.get("temperature")
    scales = _scales(filter, linear, widening)
    test = _test(filter, linear, present, scales)  # of the innovation: the same throughout
    # Until the weights are final only residuals count: rows that carry them stand for X.
    rows, split = _residual_rows(filter, linear)
    conditioned = _condition(filter, constants, linear, rows, linear.observed, weight)
    for i in range(filter.iterations):
        residual = conditioned.residual
        if linear.common:
            residual = linear.innovation - conditioned.shift[..., split:]
        s = _distance(filter, linear, residual, present, scales)
        prior_s = -conditioned.shift[..., :split]
        if filter.mad:
            scale = _mad_scale(torch.cat([torch.where(present, s, torch.nan), prior_s], dim=-1))
            s, prior_s = s / scale, prior_s / scale
        weight = filter.weight(s, constants, temperature)
        weight, gate = _gated(filter, constants, weight, test)
        weight = weight * present
        rows = linear.deviations if i + 1 == filter.iterations else rows
        deviations, observed = rows, linear.observed
        if filter.weigh_prior:
            floor = constants["prior.floor"]
            prior_weight = floor + (1.0 - floor) * filter.weight(prior_s, constants, temperature)
            ones = torch.ones_like(linear.deviations[..., 0, linear.own :])
            root = [prior_weight.rsqrt()] * (linear.own // n)
            columns = torch.cat([*root, ones], dim=-1).unsqueeze(-2)
            deviations, observed = rows * columns, observed * columns
        conditioned = _condition(filter, constants, linear, deviations, observed, weight)
    return conditioned, _record(linear, s, weight, prior_weight, gate, present)


def _residual_rows(filter: Filter, linear: Linearised) -> tuple[Tensor, int]:
    """Rows whose shifts tell the residuals, and how many of them tell the prior's.

    Identity rows: minus the whitened prior residual. With common noise also the rows of
    H X without it: H (x - m), which the measurement's own rows do not tell.
    """
    n, k = len(filter.motion.tangent), linear.deviations.shape[-1]
    rows = linear.deviations[..., :0, :]
    if filter.weigh_prior:
        unit = torch.eye(n, dtype=rows.dtype, device=rows.device)
        if linear.own > n:  # cubature: both halves
            unit = torch.cat([unit, -unit], dim=-1) * 0.5**0.5
        white = torch.nn.functional.pad(unit, (0, k - linear.own))
        rows = white.expand(*linear.mean.shape[:-1], n, k)
    split = rows.shape[-2]
    if linear.common:
        own = linear.observed[..., : linear.own]
        own = torch.nn.functional.pad(own, (0, linear.common))
        rows = torch.cat([rows, own], dim=-2)
    return rows, split


def _condition(
    filter: Filter,
    constants: Values,
    linear: Linearised,
    deviations: Tensor,
    observed: Tensor,
    weight: Tensor,
) -> Conditioned:
    """Condition so that a weight means R_ii -> R_ii / w, also for the common part of R."""
    noise = linear.independent
    if linear.common:
        noise = noise + (1.0 - weight) * (linear.total - linear.independent)
    if filter.federation is not None:
        return filter.federation.condition(
            deviations, observed, linear.innovation, weight, noise, constants
        )
    return condition(deviations, observed, linear.innovation, weight, noise)


class _Scales(NamedTuple):
    """What residuals are measured with.

    nominal: (..., m), innovation variance S_ii; per_sigma: (..., m), divides residuals;
    widening: (...) or None.
    """

    nominal: Tensor
    per_sigma: Tensor
    widening: Tensor | None


def _scales(filter: Filter, linear: Linearised, widening: Tensor | None) -> _Scales:
    nominal = square_norms(linear.observed) + linear.independent
    variance = nominal if filter.standardise == "innovation" else linear.total
    if widening is not None:
        variance = variance * widening.unsqueeze(-1)
    return _Scales(nominal, variance.rsqrt(), widening)


def _distance(
    filter: Filter, linear: Linearised, residual: Tensor, present: Tensor, scales: _Scales
) -> Tensor:
    """(..., m), residuals in sigmas as the weight function sees them: one per group."""
    s = residual * scales.per_sigma
    if filter.grouped is None:
        return s
    if filter.distance == "rms":
        return spread(filter.grouped, [group_rms(s, present, g) for g in filter.grouped])
    observed = linear.observed
    if filter.standardise == "noise":
        observed = observed[..., linear.own :]
    return positive_sqrt(_squares(filter, linear, residual, observed, present, scales.widening))


def _squares(
    filter: Filter,
    linear: Linearised,
    residual: Tensor,
    observed: Tensor,
    present: Tensor,
    widening: Tensor | None,
) -> Tensor:
    """(..., m), e^T (Z Z^T + diag r)^-1 e of each channel's group."""
    assert filter.grouped is not None
    squares = spread(
        filter.grouped,
        [
            normalised_square(residual, observed, linear.independent, present, group)
            for group in filter.grouped
        ],
    )
    return squares if widening is None else squares / widening.unsqueeze(-1)


class _Test(NamedTuple):
    """What the gate asks of each channel: NIS of its group, its degrees, R_ii / S_ii (..., m)."""

    nis: Tensor
    degrees: Tensor | None
    share: Tensor


def _test(filter: Filter, linear: Linearised, present: Tensor, scales: _Scales) -> _Test | None:
    """From the nominal innovation; None without a gate."""
    if filter.gate is None:
        return None
    share = linear.total / scales.nominal
    if filter.grouped is None:
        nis = linear.innovation.square() / scales.nominal
        if scales.widening is not None:
            nis = nis / scales.widening.unsqueeze(-1)
        return _Test(nis, None, share)
    nis = _squares(filter, linear, linear.innovation, linear.observed, present, scales.widening)
    counts = [present[..., [*group]].sum(-1) for group in filter.grouped]
    return _Test(nis, spread(filter.grouped, counts), share)


def _gated(
    filter: Filter, constants: Values, weight: Tensor, test: _Test | None
) -> tuple[Tensor, Tensor]:
    """Weight and gate of each channel."""
    if filter.gate is None or test is None:
        return weight, torch.ones_like(weight)
    temperature = constants.get("temperature")
    return filter.gate.weigh(weight, test.nis, test.degrees, constants, temperature, test.share)


def _mad_scale(residuals: Tensor) -> Tensor:
    """1.48 times the median absolute deviation over the last axis, NaN left out."""
    spread = _median((residuals - _median(residuals)).abs())
    spread = torch.where(torch.isnan(spread), 1.0, spread)  # no row at all
    # With most residuals equal the deviation is 0: keep the scale away from it.
    return (1.48 * spread).clamp_min(1e-3)


def _median(x: Tensor) -> Tensor:
    """Median over the last axis, NaN left out: the mean of the middle two of an even number."""
    low = x.nanmedian(dim=-1, keepdim=True).values
    high = -(-x).nanmedian(dim=-1, keepdim=True).values
    return 0.5 * (low + high)


def _record(
    linear: Linearised, s: Tensor, weight: Tensor, prior: Tensor, gate: Tensor, present: Tensor
) -> Record:
    return Record(
        linear.innovation,
        linear.observed,
        linear.independent,
        s,
        weight,
        prior,
        gate,
        present,
        torch.zeros_like(present),
    )
